"""When a fallback is asked, and whose answer the application gets. Times are simulated."""

from __future__ import annotations

import random
from collections import Counter
from typing import TYPE_CHECKING

import pytest

from plr.protos.model.ids import ServiceName
from plr.sidecar.core.robot.fallback import fallbacks, queue
from plr.sidecar.core.robot.fallback.fallbacks import Accepted, Fallbacks
from plr.sidecar.core.rules.service_rule import FallbackRule, ServiceRule
from plr.sidecar.core.seam.application import RequestFailed
from tests.support.builders import request_id

if TYPE_CHECKING:
    from plr.sidecar.core.base.values import RequestId

PLAN, LOCAL = ServiceName("/plan"), ServiceName("/plan_locally")
DEADLINE_S, LIFETIME_S = 1.0, 10.0
TAKES_S = 0.2
START_S = DEADLINE_S * (1 - queue.SPARE) - TAKES_S
"""When a single request has to begin."""
IN_TIME, LATE = Accepted(PLAN, late=False), Accepted(PLAN, late=True)


class World:
    """One service with a fallback that is there, and what it was asked, by number of the request."""

    def __init__(
        self, *, takes_s: float | None = TAKES_S, in_time: bool = True, drop_late: bool = False, up: bool = True
    ) -> None:
        rule = FallbackRule(LOCAL, in_time=in_time, takes_s=takes_s)
        self.outcomes: Counter[tuple[ServiceName, str]] = Counter()
        service = ServiceRule(PLAN, DEADLINE_S, LIFETIME_S, idempotent=True, drop_late=drop_late, fallback=rule)
        self.fallbacks = Fallbacks((service, ServiceRule("/*", 1.0, 10.0)), self.outcomes)
        self.up(0.0, up=up)

    def up(self, now: float, *, up: bool = True) -> None:
        self.fallbacks.set_up(frozenset([PLAN] if up else []), now)

    def submit(self, *numbers: int, now: float = 0.0, service: ServiceName = PLAN) -> None:
        for number in numbers:
            self.fallbacks.submitted(request_id(number), service, b"%d" % number, now)

    def asked(self) -> list[int]:
        """Since the last look."""
        return [int(call.payload) for call in self.fallbacks.take_calls()]

    def run_until(self, end: float) -> list[tuple[float, int]]:
        """Let timers pass; (when, what was asked)."""
        found: list[tuple[float, int]] = []
        now = 0.0
        while (due := self.fallbacks.next_timer()) is not None and due <= end:
            assert due > now or now == 0.0, "a timer that does nothing"
            now = due
            self.fallbacks.handle_timer(now)
            found += [(rounded(now), number) for number in self.asked()]
        return found

    def fail(self, number: int, now: float) -> bool:
        return self.fallbacks.network_failed(failed(request_id(number)), now)

    def counted(self) -> dict[str, int]:
        assert {outcome for _, outcome in self.outcomes} == set(fallbacks.OUTCOMES)
        return {outcome: count for (_, outcome), count in self.outcomes.items() if count}

    def assert_empty(self) -> None:
        assert len(self.fallbacks) == 0
        assert self.fallbacks._held_bytes == 0
        assert self.fallbacks.next_timer() is None


def rounded(at: float) -> float:
    return round(at, 6)


def failed(identity: RequestId) -> RequestFailed:
    return RequestFailed(identity, PLAN, "failed", "no answer", 10.0)


def test_asked_just_in_time_when_the_network_is_silent() -> None:
    world = World()
    world.submit(1)
    assert world.run_until(START_S) == [(rounded(START_S), 1)]
    assert world.fallbacks.answered(request_id(1), 0.94) == IN_TIME
    assert not world.fallbacks.deadline_missed(request_id(1), 1.0)
    assert not world.fail(1, 1.0)
    assert world.counted() == {"started": 1, "won": 1}
    world.assert_empty()


def test_not_asked_when_the_network_answers_in_time() -> None:
    world = World()
    world.submit(1)
    world.fallbacks.network_answered(request_id(1), 0.7)
    assert world.run_until(20.0) == []
    assert world.counted() == {}
    world.assert_empty()


def test_of_two_answers_the_application_gets_the_first() -> None:
    world = World()
    world.submit(1, 2)
    world.run_until(0.9)
    world.fallbacks.network_answered(request_id(1), 0.8)
    assert not world.fallbacks.has_answered(request_id(1))
    assert world.fallbacks.answered(request_id(1), 0.9) is None
    assert world.fallbacks.answered(request_id(2), 0.9) == IN_TIME
    assert world.fallbacks.has_answered(request_id(2))
    world.fallbacks.network_answered(request_id(2), 0.95)
    assert world.counted() == {"started": 2, "won": 1, "too_late": 1}
    world.assert_empty()


def test_many_at_once_begin_so_early_that_the_last_is_in_time() -> None:
    """One server, one request after the other."""
    world = World()
    world.submit(1, 2, 3)
    last = 1.0 - queue.SPARE - TAKES_S
    times = [rounded(last - ahead * TAKES_S) for ahead in (2, 1, 0)]
    assert world.run_until(last - TAKES_S) == [(times[0], 1), (times[1], 2)]
    done = 0.35
    for number in (1, 2, 3):
        done += TAKES_S
        assert world.fallbacks.answered(request_id(number), done) == IN_TIME
        world.fallbacks.handle_timer(done)
    assert world.asked() == [3]


def test_more_than_can_be_in_time_do_not_make_it_begin_earlier() -> None:
    world = World(takes_s=0.5)
    world.submit(*range(1, 30))
    assert world.run_until(0.449) == []


def test_at_once_without_a_path_unless_it_is_to_wait_for_the_miss() -> None:
    for in_time, numbers in ((True, [1]), (False, [])):
        world = World(in_time=in_time)
        world.submit(1)
        world.fallbacks.unreachable(request_id(1), 0.0)
        assert world.asked() == numbers


def test_on_a_miss_only() -> None:
    world = World(in_time=False)
    world.submit(1)
    assert world.run_until(0.999) == []
    assert world.fallbacks.deadline_missed(request_id(1), 1.0)
    assert world.asked() == [1]
    assert world.fallbacks.answered(request_id(1), 1.2) == LATE
    assert not world.fail(1, 1.2)
    assert world.counted() == {"started": 1, "late": 1}
    world.assert_empty()


def test_at_once_when_the_network_refuses() -> None:
    world = World(in_time=False)
    world.submit(1)
    assert not world.fail(1, 0.1), "the fallback may yet answer"
    assert world.asked() == [1]
    assert world.fallbacks.answered(request_id(1), 0.3) == IN_TIME
    assert world.fallbacks.take_failures() == []
    world.assert_empty()


def test_a_late_answer_is_kept_back_where_late_ones_are_worth_nothing() -> None:
    world = World(drop_late=True)
    world.submit(1, 2)
    world.run_until(1.0 - TAKES_S)
    assert world.fallbacks.deadline_missed(request_id(1), 1.0)
    assert world.fallbacks.answered(request_id(1), 1.01) is None
    assert world.counted() == {"started": 2, "late": 1}
    assert world.fail(1, 2.0)
    assert not world.fail(2, 2.0)
    assert world.run_until(LIFETIME_S) == []
    assert world.fallbacks.take_failures() == [failed(request_id(2))]
    world.assert_empty()


def test_missing_is_told_and_asked_when_it_comes() -> None:
    world = World(up=False)
    world.submit(1, 2)
    assert world.run_until(1.0) == []
    assert world.fallbacks.deadline_missed(request_id(1), 1.0)
    assert world.fail(2, 1.0), "nobody else is there"
    world.up(1.5)
    assert world.asked() == [1]
    assert world.fallbacks.answered(request_id(1), 1.7) == LATE
    assert world.counted() == {"missing": 2, "started": 1, "late": 1}


def test_what_went_down_with_it_is_asked_again_but_not_for_ever() -> None:
    world = World()
    world.submit(1)
    world.run_until(0.8)
    world.up(0.85, up=False)
    assert world.asked() == []
    world.up(0.9)
    for _ in range(fallbacks.MAX_ATTEMPTS - 1):
        assert world.asked() == [1]
        world.fallbacks.replaced(PLAN, 0.95)
    assert world.asked() == []
    assert world.counted() == {"started": 1, "lost": 1}
    assert world.fail(1, 2.0)
    world.assert_empty()


def test_a_hung_one_is_given_up_and_tried_again() -> None:
    world = World()
    world.submit(1)
    begins = [rounded(START_S + turn * queue.STALL_S) for turn in range(fallbacks.MAX_ATTEMPTS)]
    assert world.run_until(9.0) == [(at, 1) for at in begins]
    assert not world.fallbacks._queues[PLAN].called, "there is room for the next"
    assert world.fallbacks.answered(request_id(1), 9.0) is None
    assert world.fail(1, 10.0)
    assert world.counted() == {"started": 1, "lost": 1}


def test_in_an_overload_those_go_first_that_can_be_in_time() -> None:
    world = World()
    for number in range(6):
        world.submit(number)
        world.fallbacks.unreachable(request_id(number), 0.0)
    assert world.asked() == [0, 1]
    world.submit(6, now=1.0)
    world.fallbacks.unreachable(request_id(6), 1.0)
    world.fallbacks.answered(request_id(0), 1.0)
    assert world.asked() == [6], "the others are late whatever happens"


def test_the_queue_has_an_end() -> None:
    world = World()
    count = fallbacks.MAX_WANTED + queue.MAX_CALLED
    for number in range(count + 3):
        world.submit(number)
        world.fallbacks.unreachable(request_id(number), 0.0)
    assert world.counted() == {"started": queue.MAX_CALLED, "overloaded": 3}
    assert world.fail(count, 0.5)
    assert not world.fail(count - 1, 0.5)


def test_payloads_are_not_kept_beyond_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("plr.sidecar.core.robot.fallback.fallbacks.MAX_FALLBACK_BYTES", 2)
    world = World()
    world.submit(1, 2, 3)
    assert world.counted() == {"overloaded": 1}
    assert world.fallbacks.deadline_missed(request_id(3), 1.0)
    assert world.fail(3, 1.0)


def test_what_it_takes_is_learned() -> None:
    world = World(takes_s=None)
    world.submit(1)
    assert world.run_until(0.45) == [(rounded(1 - queue.SPARE - 0.5), 1)], "half the deadline at first"
    world.fallbacks.answered(request_id(1), 0.55)
    assert world.fallbacks.expected_s(PLAN) == pytest.approx(0.15), "half as much again while little is known"
    for number in range(2, 60):
        begin = float(number)
        world.submit(number, now=begin)
        world.fallbacks.unreachable(request_id(number), begin)
        world.fallbacks.answered(request_id(number), begin + number / 1000)
    assert world.fallbacks.expected_s(PLAN) == pytest.approx(0.1)


def test_time_spent_behind_another_request_is_not_counted() -> None:
    world = World(takes_s=None)
    world.submit(1, 2)
    for number in (1, 2):
        world.fallbacks.unreachable(request_id(number), 0.0)
    for number, answered_at in ((1, 0.1), (2, 0.2)):
        world.fallbacks.answered(request_id(number), answered_at)
    assert world.fallbacks.expected_s(PLAN) == pytest.approx(0.15)


def test_one_too_slow_for_the_deadline_does_not_run_for_every_request() -> None:
    world = World(takes_s=None)
    world.submit(1)
    world.fallbacks.unreachable(request_id(1), 0.0)
    assert world.asked() == [1]
    assert world.fallbacks.answered(request_id(1), 1.5) == LATE
    world.submit(2, now=2.0)
    assert world.run_until(2.999) == []
    world.fallbacks.deadline_missed(request_id(2), 3.0)
    assert world.asked() == [2]


def test_services_without_a_fallback_leave_nothing_behind() -> None:
    world = World()
    world.submit(1, service=ServiceName("/other"))
    assert world.fallbacks.deadline_missed(request_id(1), 1.0)
    assert world.fail(1, 2.0)
    world.assert_empty()


@pytest.mark.parametrize("drop_late", [False, True])
def test_whatever_happens_each_request_ends_once_and_nothing_is_left(*, drop_late: bool) -> None:
    """Networks and fallbacks that answer, fail, vanish and return at random."""
    rng = random.Random(3)
    world = World(takes_s=None, drop_late=drop_late)
    ends: Counter[int] = Counter()
    network: list[tuple[float, int, str]] = []
    asked: list[tuple[float, int]] = []
    count = 0
    for step in range(4000):
        now = step * 0.01
        if step < 2500 and rng.random() < 0.2:
            count += 1
            world.submit(count, now=now)
            fate = rng.choice(["answer", "fail", "unreachable"])
            network.append((now + rng.choice([0.05, 0.9, 3.0]), count, fate))
        if rng.random() < 0.01:
            world.up(now, up=rng.random() < 0.7)
        if rng.random() < 0.005:
            world.fallbacks.replaced(PLAN, now)
        for at, number, fate in [event for event in network if event[0] <= now]:
            network.remove((at, number, fate))
            if fate == "answer":
                ends[number] += not world.fallbacks.has_answered(request_id(number))
                world.fallbacks.network_answered(request_id(number), now)
            elif fate == "fail":
                ends[number] += world.fail(number, now)
            else:
                world.fallbacks.unreachable(request_id(number), now)
                network.append((at + LIFETIME_S - 3.0, number, "fail"))
        world.fallbacks.handle_timer(now)
        asked += [(now + rng.choice([0.05, 0.3, 5.0]), number) for number in world.asked()]
        for at, number in [answer for answer in asked if answer[0] <= now]:
            asked.remove((at, number))
            if rng.random() < 0.1:
                world.fallbacks.refused(request_id(number), now)
            else:
                ends[number] += world.fallbacks.answered(request_id(number), now) is not None
        for failure in world.fallbacks.take_failures():
            ends[next(number for number in range(1, count + 1) if request_id(number) == failure.request_id)] += 1
    assert set(ends.values()) == {1}
    assert len(ends) == count > 400
    world.assert_empty()
