"""One timer for each key."""

from __future__ import annotations

import random

import pytest

from plr.sidecar.core.base.timers import SKIPPED_AT_ONCE, SLACK, Timers, first_of


def test_the_earliest_comes_first_and_a_new_time_replaces_the_old() -> None:
    timers: Timers[str] = Timers()
    timers.arm("a", 2.0)
    timers.arm("b", 1.0)
    timers.arm("a", 0.5)
    assert timers.next() == 0.5
    assert timers.pop_due(0.4) is None
    assert [timers.pop_due(2.0), timers.pop_due(2.0), timers.pop_due(2.0)] == ["a", "b", None]
    assert timers.next() is None


def test_disarmed_and_rearmed_to_the_same_time_fires_once() -> None:
    timers: Timers[str] = Timers()
    for due in (1.0, 2.0, 1.0, None, 1.0):
        timers.arm("a", due)
    assert [timers.pop_due(3.0), timers.pop_due(3.0)] == ["a", None]


def test_outdated_times_do_not_pile_up() -> None:
    timers: Timers[int] = Timers()
    for turn in range(10_000):
        timers.arm(turn % 10, 1.0 + turn % 7)
        timers.arm(turn % 10, 1000.0 + turn)
        assert len(timers._heap) <= 2 * 10 + SLACK + 1
    assert timers.next() == 1000.0 + 9_990


def test_behaves_as_a_dictionary_of_times() -> None:
    rng = random.Random(5)
    timers: Timers[int] = Timers()
    model: dict[int, float] = {}
    now = 0.0
    for _ in range(3000):
        key = rng.randrange(20)
        due = rng.choice([None, now + rng.random()])
        timers.arm(key, due)
        model.pop(key, None)
        if due is not None:
            model[key] = due
        assert timers.next() == min(model.values(), default=None)
        if rng.random() < 0.2:
            now += rng.random()
            while (fired := timers.pop_due(now)) is not None:
                assert model.pop(fired) <= now
            assert all(left > now for left in model.values())


@pytest.mark.audit("dp-10")
def test_a_look_drops_some_of_what_is_over() -> None:
    heap = [(float(number), number) for number in range(1000)]
    live = {999}
    looks = [first_of(heap, live) for _ in range(1 + 999 // SKIPPED_AT_ONCE)]
    assert looks[0] == SKIPPED_AT_ONCE
    assert looks[-1] == 999.0
    live.clear()
    assert first_of(heap, live) is None
