from __future__ import annotations

import random

import pytest

from lab.simulated.sessions import agree, session_of, with_credential
from plr.protos.base.token_bucket import TokenBucket
from plr.protos.model.ids import Address, InterfaceId, Role, SessionId
from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.path.congestion.model_controller import ModelController
from plr.sidecar.core.path.congestion.rtt import UNSTABLE_FLOOR_S
from plr.sidecar.core.path.key_exchange import DEFAULT_LIMITS
from plr.sidecar.core.path.keys import make_path_keys
from plr.sidecar.core.path.path import DOWN_FACTOR, DOWN_FLOOR_S, Path
from plr.sidecar.core.path.probing import FIRST_PROBE_S, IDLE_PROBE_S, MAX_PROBE_S
from tests.support.builders import path, peer

RNG = random.Random(1)
HERE, THERE, ELSEWHERE = ("192.0.2.1", 1), ("192.0.2.2", 2), ("192.0.2.3", 3)


def new() -> Path:
    of_cloud = session_of("robot-1", Role.ROBOT, 9).admit(peer("cloud-a", session=1))
    of_robot = session_of("cloud-a", Role.CLOUD, 1).admit(with_credential(peer("robot-1", session=9, role=Role.ROBOT)))
    keys, theirs = (
        make_path_keys(pair, InterfaceId(0), InterfaceId(0), DEFAULT_LIMITS, 100.0, leads=pair is of_cloud)
        for pair in (of_cloud, of_robot)
    )
    agree(keys, theirs, 100.0, RNG)
    budget, exchanges = (TokenBucket(rate=1200.0, burst=65_536, now=100.0) for _ in range(2))
    return Path(
        path(), SessionId(1), keys, (HERE, THERE), 0, 100.0, RNG, budget, exchanges, ModelController, leads=True
    )


def ask(subject: Path, now: float) -> int:
    """Return the id of a probe that leaves, by plan."""
    probe = subject.ask(now, subject.remote or THERE)
    subject.plan_probe(now)
    return probe


def destinations(subject: Path, now: float = 100.0) -> tuple[Address, ...]:
    return (subject.remote,) if subject.goes_to_one and subject.remote else tuple(subject.destinations(now, 100))


def up(now: float = 100.0, rtt_s: float = 0.01) -> Path:
    subject = new()
    probe = ask(subject, now - rtt_s)
    assert subject.answered_probe(probe, now) == now - rtt_s
    assert subject.made_progress(now)
    return subject


def test_a_new_path_is_down_and_probes_with_growing_gaps() -> None:
    subject = new()
    assert subject.state is PathState.DOWN
    now, gaps = 100.0, []
    for _ in range(12):
        gaps.append(subject.probe_at - now)
        now = subject.probe_at
        ask(subject, now)
    assert gaps[0] == 0
    assert 0.9 * FIRST_PROBE_S <= gaps[1] <= 1.1 * FIRST_PROBE_S
    assert 0.9 * MAX_PROBE_S <= gaps[-1] <= 1.1 * MAX_PROBE_S
    assert subject.silence_timer is None, "a path that is down has nothing to lose"


def test_up_unstable_down_up() -> None:
    subject = up(rtt_s=0.01)
    assert subject.silence_timer is None, "nothing waits for an answer"
    subject.waits_for_answer(101.0)
    assert subject.silence_timer == pytest.approx(101.0 + UNSTABLE_FLOOR_S)
    assert subject.check_silence(101.0 + UNSTABLE_FLOOR_S - 0.001) is None
    assert subject.check_silence(101.0 + UNSTABLE_FLOOR_S) is PathState.UNSTABLE
    assert subject.probe_at == 101.0 + UNSTABLE_FLOOR_S, "it is asked at once"
    down_at = 101.0 + max(DOWN_FACTOR * UNSTABLE_FLOOR_S, DOWN_FLOOR_S)
    assert subject.silence_timer == pytest.approx(down_at)
    assert subject.check_silence(down_at) is PathState.DOWN
    assert subject.check_silence(down_at + 100) is None
    probe = ask(subject, down_at)
    assert subject.answered_probe(probe, down_at + 0.01)
    assert subject.made_progress(down_at + 0.01)
    assert subject.state is PathState.UP


def test_an_unstable_path_that_answers_is_up_again() -> None:
    subject = up()
    subject.waits_for_answer(101.0)
    subject.check_silence(101.1)
    assert subject.state is PathState.UNSTABLE
    assert subject.made_progress(101.2)
    assert not subject.made_progress(101.3), "already up"


def test_the_silence_is_counted_from_the_first_unanswered_datagram() -> None:
    subject = up()
    subject.waits_for_answer(101.0)
    subject.waits_for_answer(101.05)
    assert subject.silence_timer == pytest.approx(101.0 + UNSTABLE_FLOOR_S)


def test_a_quiet_path_is_probed_at_ease_and_traffic_postpones_it() -> None:
    subject = up(now=100.0)
    assert subject.probe_at == 100.0 + IDLE_PROBE_S
    subject.made_progress(100.4)
    assert subject.probe_at == 100.4 + IDLE_PROBE_S


def test_an_unstable_path_is_probed_fast() -> None:
    subject = up()
    subject.waits_for_answer(101.0)
    subject.check_silence(101.1)
    ask(subject, 101.1)
    assert subject.probe_at <= 101.1 + 1.1 * FIRST_PROBE_S


def test_a_path_that_was_up_is_asked_at_least_four_times_a_second_for_ten_seconds() -> None:
    subject = up()
    subject.go_down()
    gaps: list[float] = []
    while sum(gaps) < 100.0:
        now = 101.0 + sum(gaps)
        ask(subject, now)
        gaps.append(subject.probe_at - now)
    within = [gap for count, gap in enumerate(gaps) if sum(gaps[:count]) < 10.0]
    assert max(within) < 0.3
    assert len(within) < 10.0 / (2 * FIRST_PROBE_S)
    assert gaps[-1] == pytest.approx(MAX_PROBE_S, rel=0.11)


def test_hearing_a_dead_path_hastens_its_probe_but_no_flood_does() -> None:
    subject = new()
    now = 100.0
    for _ in range(10):
        ask(subject, now)
        now += 2.0
    subject.hasten_probe(now)
    assert subject.probe_at <= now
    ask(subject, now)
    for _ in range(100):
        subject.hasten_probe(now + 0.001)
    assert subject.probe_at == pytest.approx(now + FIRST_PROBE_S)


@pytest.mark.audit("dp-2")
def test_of_a_slow_path_nothing_is_expected_before_its_round_trip_is_over() -> None:
    subject = up(rtt_s=4.0)
    subject.waits_for_answer(200.0)
    assert subject.check_silence(204.9) is None
    assert subject.check_silence(205.1) is PathState.UNSTABLE
    assert subject.check_silence(206.9) is None
    assert subject.check_silence(207.1) is PathState.DOWN


@pytest.mark.audit("dp-2")
def test_a_queue_that_is_in_use_is_dead_a_second_after_its_last_sign_of_life() -> None:
    """What stands in it arrives one after the other."""
    subject = up(rtt_s=0.05)
    for turn in range(20):
        subject.recovery.on_finished_sent(subject.recovery.take_numbers(), 101.0 + turn / 10, 100, ())
        subject.waits_for_answer(101.0 + turn / 10)
        subject.recovery.rtt.sample(1.0, 102.0 + turn / 10)
    subject.recovery.sent = subject.recovery.sent[10:]
    subject.made_progress(103.0)
    assert subject.silence_timer == pytest.approx(104.2, abs=0.2)


@pytest.mark.audit("dp-2")
def test_only_what_was_asked_counts_as_an_answer_and_once() -> None:
    subject = new()
    probe = ask(subject, 100.0)
    assert not subject.answered_probe(probe + 1, 100.1)
    assert subject.answered_probe(probe, 100.1)
    assert not subject.answered_probe(probe, 100.1)
    assert subject.made_progress(100.1)
    late = ask(subject, 100.2)
    subject.go_down()
    assert subject.answered_probe(late, 104.2) == 100.2, "a slow path is not a dead one"
    assert subject.recovery.rtt.latest == pytest.approx(4.0)


def test_probes_go_to_every_candidate_until_the_path_is_up() -> None:
    subject = new()
    assert destinations(subject) == (HERE, THERE)
    subject.address.move(ELSEWHERE, 100.0)
    assert destinations(subject) == (HERE, THERE), "nothing came from there"
    subject.address.came(ELSEWHERE, 50)
    assert destinations(subject) == (ELSEWHERE, HERE, THERE)
    subject.address.move(THERE, 100.0)
    assert destinations(subject) == (HERE, THERE)
    subject.state = PathState.UP
    assert destinations(subject) == (THERE,)


def test_a_dormant_peer_is_asked_each_time_where_it_proved_to_be() -> None:
    subject = new()
    subject.announced((HERE, THERE), 64)
    subject.address.prove(HERE)
    subject.probing.dormant = True
    now, asked = 100.0, []
    while now < 100.0 + 30 * 86_400.0:
        asked.append(subject.destinations(now, 100))
        subject.plan_probe(now)
        now = subject.probe_at
    assert all(HERE in addresses for addresses in asked)
    assert [THERE in addresses for addresses in asked[-8:]].count(True) == 2


def test_after_a_rebinding_every_candidate_is_asked_until_one_answers() -> None:
    subject = up()
    subject.address.move(ELSEWHERE, 100.0)
    subject.address.came(ELSEWHERE, 50)
    assert destinations(subject) == (ELSEWHERE,)
    subject.start_afresh(101.0)
    assert subject.state is PathState.UNSTABLE
    assert not subject.recovery.rtt.has_sample
    assert destinations(subject) == (ELSEWHERE, HERE, THERE)
    assert subject.answered_probe(ask(subject, 101.0), 101.02)
    assert subject.made_progress(101.02)
    assert destinations(subject) == (ELSEWHERE,)


def test_a_path_that_moves_says_whether_that_is_by_another_route() -> None:
    subject = new()
    assert not subject.move(HERE, 100.0), "there was none before"
    subject.note_source("192.0.2.100")
    assert not subject.move((HERE[0], 9), 101.0), "a NAT changed its port"
    assert subject.source == "192.0.2.100"
    assert subject.move(THERE, 102.0)
    assert subject.remote == THERE
    assert subject.source is None
