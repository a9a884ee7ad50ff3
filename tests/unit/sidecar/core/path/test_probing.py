from __future__ import annotations

import itertools
import random

import pytest

from plr.sidecar.core.path.congestion.rtt import LONGEST_ANSWER_S
from plr.sidecar.core.path.probing import (
    FIRST_PROBE_S,
    FREE_ADDRESSES,
    IDLE_PROBE_S,
    IDLE_SPREAD,
    MAX_DORMANT_PROBE_S,
    MAX_IDLE_PROBE_S,
    MAX_PROBE_S,
    MAX_PROBES_OUT,
    MAX_WATCH_PROBE_S,
    WATCH_FACTOR,
    Probing,
)

RNG = random.Random(1)
THERE = ("192.0.2.2", 2)
NAT_S = 30.0
"""What the most forgetful NATs keep a binding for."""


def up(*, leads: bool = True, now: float = 100.0) -> Probing:
    subject = Probing(now, RNG, leads=leads)
    subject.came_up(now)
    return subject


def rest(subject: Probing, until: float) -> list[float]:
    """When it asks while nothing else happens and every probe is answered at once."""
    asked = []
    while subject.at < until:
        now = subject.at
        asked.append(now)
        assert subject.answered(subject.ask(now, THERE, sealed=True), now + 0.01)
        subject.plan_up(now)
        subject.proven(now + 0.01)
    return asked


def test_an_answer_counts_once_as_long_as_the_slowest_path_takes_and_no_longer() -> None:
    subject = Probing(100.0, RNG, leads=True)
    ids = [subject.ask(100.0 + FIRST_PROBE_S * turn, THERE, sealed=turn % 2 == 0) for turn in range(200)]
    assert subject.answered(ids[0], 110.0) == (100.0, THERE, True)
    assert subject.answered(ids[0], 110.0) is None
    assert subject.answered(ids[1], 110.0) == (100.0 + FIRST_PROBE_S, THERE, False)
    assert subject.answered(ids[2], 100.0 + 2 * FIRST_PROBE_S + LONGEST_ANSWER_S) is None
    assert subject.answered(ids[-1] + 1, 110.0) is None


def test_what_is_remembered_is_bounded_in_number_and_age() -> None:
    subject = Probing(100.0, RNG, leads=True)
    for turn in range(5 * MAX_PROBES_OUT):
        subject.ask(100.0 + turn * 0.001, THERE, sealed=True)
        subject.ask_back(100.0 + turn * 0.001, THERE)
    assert len(subject._out) == len(subject._back) == MAX_PROBES_OUT
    subject.ask(100.0 + 3 * LONGEST_ANSWER_S, THERE, sealed=True)
    assert len(subject._out) == 1


def test_who_makes_us_ask_back_does_not_make_us_forget_what_we_asked() -> None:
    """Introductions may be repeated by whoever knows the token of the peer."""
    subject = Probing(100.0, RNG, leads=True)
    mine = subject.ask(100.0, THERE, sealed=True)
    for _ in range(5 * MAX_PROBES_OUT):
        subject.ask_back(100.1, THERE)
    assert subject.answered(mine, 100.2) == (100.0, THERE, True)


def test_a_path_that_rests_is_asked_ever_less_often_but_before_any_nat_forgets_it() -> None:
    asked = rest(up(), 2000.0)
    gaps = [later - earlier for earlier, later in itertools.pairwise(asked)]
    assert all(gap <= (1 + IDLE_SPREAD) * IDLE_PROBE_S + 0.02 for gap in gaps[:5])
    assert max(gaps) <= (1 + IDLE_SPREAD) * MAX_IDLE_PROBE_S + 0.02 < NAT_S
    late = gaps[-100:]
    assert sum(late) / len(late) == pytest.approx(MAX_IDLE_PROBE_S, rel=0.1)
    assert max(late) - min(late) > IDLE_SPREAD * MAX_IDLE_PROBE_S, "those of many robots drift apart"


def test_a_path_in_use_is_asked_as_often_as_ever() -> None:
    subject = up()
    rest(subject, 1000.0)
    subject.used(1000.0)
    assert subject.at <= 1000.0 + IDLE_PROBE_S
    subject.proven(1000.2)
    assert subject.at <= 1000.2 + IDLE_PROBE_S
    asked = rest(subject, 1003.0)
    assert len(asked) in range(5, 9)


def test_a_path_that_is_needed_is_asked_at_once_unless_it_just_answered() -> None:
    subject = up()
    rest(subject, 1000.0)
    subject.needed(1000.0)
    assert subject.at == 1000.0
    subject.plan_up(1000.0)
    subject.proven(1000.05)
    before = subject.at
    subject.needed(1000.1)
    assert subject.at == pytest.approx(before)


def test_who_does_not_lead_asks_along_with_its_answers_and_alone_only_when_nobody_asks() -> None:
    leader, watcher = up(), up(leads=False)
    alone = 0
    for now in rest(leader, 1000.0):
        alone += watcher.at < now
        watcher.asked(now)
        if watcher.at == now:
            assert watcher.answered(watcher.ask(now, THERE, sealed=True), now + 0.01)
            watcher.plan_up(now)
            watcher.proven(now + 0.01)
    assert alone == 0
    assert watcher.at <= 1000.0 + WATCH_FACTOR * (1 + IDLE_SPREAD) * MAX_IDLE_PROBE_S
    watcher.used(1000.0)
    assert watcher.at <= 1000.0 + WATCH_FACTOR * IDLE_PROBE_S


def test_what_is_down_is_looked_for_more_rarely_by_who_does_not_lead() -> None:
    for leads, slowest in ((True, MAX_PROBE_S), (False, MAX_WATCH_PROBE_S)):
        for was_up in (False, True):
            subject = up(leads=leads) if was_up else Probing(100.0, RNG, leads=leads)
            now = 100.0
            for _ in range(400):
                subject.ask(now, THERE, sealed=False)
                subject.plan_down(now)
                now = subject.at
            assert subject.at - subject.last_at == pytest.approx(slowest, rel=0.11)


@pytest.mark.audit("dp-11")
def test_a_dormant_peer_is_asked_a_fiftieth_of_its_downtime_apart_and_ever_less_often() -> None:
    subject = up()
    subject.dormant = True
    subject.begin_again(100.0)
    asked = []
    while subject.at < 100.0 + 7 * 86_400.0:
        asked.append(subject.at)
        subject.plan_down(subject.at)
    after = [at - 100.0 for at in asked]
    assert all(gap < 0.03 * at + 0.1 for at, gap in zip(after[1:], _gaps(after), strict=True))
    assert 0.9 * MAX_DORMANT_PROBE_S < max(_gaps(after)) <= MAX_DORMANT_PROBE_S
    assert sum(at < 3600.0 for at in after) < 500
    assert sum(at > 6 * 86_400.0 for at in after) < 1.2 * 86_400.0 / MAX_DORMANT_PROBE_S


def test_who_does_not_lead_looks_for_a_dormant_peer_as_for_any_other() -> None:
    subject = Probing(100.0, RNG, leads=False)
    subject.dormant = True
    for _ in range(400):
        subject.plan_down(subject.at)
    before = subject.at
    subject.plan_down(before)
    assert subject.at - before == pytest.approx(MAX_WATCH_PROBE_S, rel=0.11)


def _gaps(times: list[float]) -> list[float]:
    return [later - at for at, later in itertools.pairwise(times)]


@pytest.mark.parametrize("times", [4, 8])
def test_a_dormant_peer_of_many_addresses_is_asked_no_more_rarely_but_only_at_some_of_them(times: int) -> None:
    subject = up()
    subject.dormant, subject.crowd = True, times * FREE_ADDRESSES
    subject.begin_again(100.0)
    asked: dict[int, list[float]] = {}
    longest = 0.0
    while subject.at < 100.0 + 30 * 86_400.0:
        now = subject.at
        for number in filter(subject.has_turn, range(subject.crowd)):
            asked.setdefault(number, []).append(now)
        subject.plan_down(now)
        longest = max(longest, subject.at - now)
    assert 0.9 * MAX_DORMANT_PROBE_S < longest <= MAX_DORMANT_PROBE_S
    assert [at[0] for at in asked.values()] == [100.0] * subject.crowd, "all of them at first"
    last = [at[-1] - at[-2] for at in asked.values()]
    assert sum(last) / len(last) == pytest.approx(times * MAX_DORMANT_PROBE_S, rel=0.15)


@pytest.mark.parametrize("was_up", [False, True])
def test_a_peer_of_many_addresses_gets_no_more_probes_than_one_of_some(was_up: bool) -> None:
    def asked(addresses: int) -> float:
        subject = up() if was_up else Probing(100.0, RNG, leads=True)
        subject.crowd = addresses
        now, probes = 100.0, 0
        while now < 1100.0:
            subject.ask(now, THERE, sealed=False)
            subject.plan_down(now)
            subject.hasten(now, 0.0)
            probes += now > 600.0
            now = subject.at
        return probes * addresses

    assert asked(256) == pytest.approx(asked(FREE_ADDRESSES), rel=0.05)


def test_no_wish_makes_it_ask_twice_in_a_round_trip() -> None:
    subject = Probing(100.0, RNG, leads=True)
    for _ in range(20):
        subject.ask(100.0, THERE, sealed=False)
        subject.plan_down(100.0)
    subject.hasten(100.01, 0.0)
    assert subject.at == pytest.approx(100.0 + FIRST_PROBE_S)
    subject.at = 101.0
    subject.hasten(100.1, 0.7)
    assert subject.at == pytest.approx(100.7)
    subject.at = 101.0
    subject.hasten(100.1, 4.0)
    assert subject.at == 101.0
