"""The order in which requests wait for a server."""

from __future__ import annotations

import math
import random

import pytest

from plr.sidecar.core.base.values import Priority
from plr.sidecar.ros.cloud.request_queue import REMOVED_SLACK, RequestQueue


def drain(queue: RequestQueue[str], now: float, *, late_too: bool = True) -> list[str]:
    taken = []
    while (found := queue.take(now, now + 1.0, late_too=late_too)) is not None:
        taken.append(found[0])
    return taken


def test_priority_then_fresh_then_deadline_then_arrival() -> None:
    queue: RequestQueue[str] = RequestQueue()
    queue.add("low", Priority.LOW, 6.0, math.inf)
    queue.add("late", Priority.NORMAL, 1.0, math.inf)
    queue.add("second", Priority.NORMAL, 8.0, math.inf)
    queue.add("third", Priority.NORMAL, 8.0, math.inf)
    queue.add("first", Priority.NORMAL, 7.0, math.inf)
    queue.add("high and late", Priority.HIGH, 2.0, math.inf)
    queue.add("high", Priority.HIGH, 9.0, math.inf)
    assert drain(queue, 5.0) == ["high", "high and late", "first", "second", "third", "late", "low"]
    assert len(queue) == 0


def test_the_late_stay_when_they_are_not_wanted() -> None:
    queue: RequestQueue[str] = RequestQueue()
    queue.add("late", Priority.HIGH, 1.0, math.inf)
    queue.add("fresh", Priority.LOW, 9.0, math.inf)
    assert drain(queue, 1.0, late_too=False) == ["fresh"]
    assert len(queue) == 1
    assert queue.take(1.0, 2.0, late_too=True) == ("late", True)


def test_what_expires_before_it_is_answered_comes_last_and_the_freshest_of_it_first() -> None:
    queue: RequestQueue[str] = RequestQueue()
    queue.add("hopeless", Priority.HIGH, 1.0, 5.8)
    queue.add("less so", Priority.HIGH, 2.0, 6.0)
    queue.add("late", Priority.LOW, 4.0, 6.1)
    queue.add("fresh", Priority.LOW, 5.5, 5.6)
    assert drain(queue, 5.0) == ["fresh", "late", "less so", "hopeless"]


@pytest.mark.parametrize("seed", range(20))
def test_against_a_plain_sort(seed: int) -> None:
    """Adding, removing and taking at random: what is taken is always what sorting all of it would give."""
    rng = random.Random(seed)
    queue: RequestQueue[int] = RequestQueue()
    waiting: dict[int, tuple[Priority, float, float]] = {}
    now = 0.0
    for number in range(500):
        now += rng.uniform(0.0, 0.1)
        match rng.randrange(4):
            case 0 | 1:
                deadline = now + rng.uniform(-1.0, 3.0)
                waiting[number] = rng.choice(list(Priority)), deadline, deadline + rng.choice([0.1, 1.0, 9.0])
                queue.add(number, *waiting[number])
            case 2 if waiting:
                gone = rng.choice(list(waiting))
                del waiting[gone]
                queue.remove(gone)
                assert gone not in queue
            case _:
                late_too = rng.random() < 0.5
                order = []
                for request, (priority, deadline, expires) in waiting.items():
                    late = deadline <= now
                    hopeless = late and expires <= now + 1.0
                    if late_too or not late:
                        first = -expires if hopeless else deadline
                        order.append(((hopeless, priority, late, first, request), request, late))
                expected = min(order)[1:] if order else None
                assert queue.take(now, now + 1.0, late_too=late_too) == expected
                if expected is not None:
                    del waiting[expected[0]]
        assert len(queue) == len(waiting)
    assert queue.take_all() == list(waiting)
    assert queue.take(now, now + 1.0, late_too=True) is None


def test_what_is_removed_is_not_held_for_long() -> None:
    queue: RequestQueue[int] = RequestQueue()
    queue.add(0, Priority.NORMAL, 0.5, math.inf)
    for number in range(1, 1000):
        queue.add(number, Priority.NORMAL, 9.0, math.inf)
        queue.remove(number)
        held = sum(len(heap) for waiting in queue._classes.values() for heap in waiting.heaps())
        assert held <= REMOVED_SLACK + 3
    assert queue.take(1.0, 2.0, late_too=True) == (0, True)
