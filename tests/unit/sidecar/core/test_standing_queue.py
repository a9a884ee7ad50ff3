from __future__ import annotations

from sidecar.core.rtt import RttEstimator
from sidecar.core.standing_queue import FLOOR_MEMORY_S, PEAK_MEMORY_S, StandingQueue

FLOOR_S = 0.050


class World:
    """A queue, and the round trips it is told of, one every 10 ms."""

    def __init__(self) -> None:
        self.queue = StandingQueue()
        self.rtt = RttEstimator()
        self.now = 0.0
        self.take(FLOOR_S, 1.0)

    def take(self, rtt_s: float, seconds: float = 0.3) -> bool:
        """Whether any of them lowered the floor."""
        fell = False
        end = self.now + seconds
        while self.now < end:
            self.now += 0.01
            self.rtt.sample(rtt_s, self.now)
            fell |= self.queue.note(rtt_s, self.rtt, self.now)
        return fell

    def stands(self) -> bool:
        return self.queue.stands(self.rtt)

    def is_full(self) -> bool:
        return self.queue.is_full(self.rtt)


def test_a_queue_stands_when_round_trips_stay_above_the_floor() -> None:
    world = World()
    assert not world.stands()
    world.take(2 * FLOOR_S)
    assert world.stands()
    world.take(1.1 * FLOOR_S)
    assert not world.stands()


def test_a_moment_is_no_standing_queue_but_the_datagram_met_one() -> None:
    world = World()
    world.rtt.sample(2 * FLOOR_S, world.now)
    assert not world.stands()
    world = World()
    assert world.queue.is_met_by(2 * FLOOR_S, world.rtt)
    assert not world.queue.is_met_by(1.1 * FLOOR_S, world.rtt)


def test_it_is_full_only_about_as_long_as_the_longest_of_late() -> None:
    world = World()
    world.take(3 * FLOOR_S)
    assert world.is_full()
    world.take(2 * FLOOR_S)
    assert world.stands()
    assert not world.is_full()
    world.take(2 * FLOOR_S, 1.5 * PEAK_MEMORY_S)
    assert world.is_full()
    world.take(1.5 * FLOOR_S)
    world.take(2 * FLOOR_S)
    assert world.is_full()


def test_an_empty_queue_is_never_full() -> None:
    assert not World().is_full()


def test_a_clearly_lower_floor_tells_that_the_one_before_was_a_queue() -> None:
    world = World()
    assert not world.take(0.9 * FLOOR_S)
    assert world.take(0.5 * FLOOR_S)
    world.take(0.9 * FLOOR_S)
    assert world.stands()


def test_a_longer_route_is_the_floor_after_a_while() -> None:
    world = World()
    world.take(2 * FLOOR_S, FLOOR_MEMORY_S + 1.0)
    assert not world.stands()
