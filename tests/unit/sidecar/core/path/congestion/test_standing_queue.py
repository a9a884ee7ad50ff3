"""Round trips that are longer than the least: a queue, or a longer route."""

from __future__ import annotations

import pytest

from plr.sidecar.core.path.congestion.rtt import RttEstimator
from plr.sidecar.core.path.congestion.standing_queue import (
    FLOOR_MEMORY_S,
    PEAK_MEMORY_S,
    YIELD_S,
    YIELD_WINDOWS,
    FloorChange,
    StandingQueue,
)

FLOOR_S = 0.050
YIELDED_S = YIELD_WINDOWS * YIELD_S
"""It is told a round trip and a sample or two later."""


class World:
    """A queue, and the round trips it is given, one every 10 ms."""

    def __init__(self) -> None:
        self.queue = StandingQueue()
        self.rtt = RttEstimator()
        self.now = 0.0
        self.take(FLOOR_S, 1.0)

    def take(self, rtt_s: float, seconds: float = 0.3) -> FloorChange | None:
        """What they said about the floor last."""
        told = None
        end = self.now + seconds
        while self.now < end:
            self.now += 0.01
            self.rtt.sample(rtt_s, self.now)
            told = self.queue.note(rtt_s, self.rtt, self.now) or told
        return told

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


def test_it_is_full_only_about_as_long_as_the_longest_recent_one() -> None:
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
    assert world.take(0.9 * FLOOR_S) is None
    assert world.take(0.5 * FLOOR_S) is FloorChange.FELL
    world.take(0.9 * FLOOR_S)
    assert world.stands()


def test_a_longer_route_is_the_floor_after_a_while() -> None:
    world = World()
    world.take(2 * FLOOR_S, FLOOR_MEMORY_S + 1.0)
    assert not world.stands()


def test_what_stays_when_less_is_sent_is_a_longer_route() -> None:
    world = World()
    world.take(3 * FLOOR_S)
    assert world.stands()
    world.queue.on_cut(world.rtt, world.now)
    assert world.take(3 * FLOOR_S, YIELDED_S) is None, "too soon to tell"
    world.queue.on_cut(world.rtt, world.now)  # what is lost meanwhile does not put it off
    assert world.take(3 * FLOOR_S, 0.5) is FloorChange.ROSE
    assert not world.stands()
    assert world.take(3 * FLOOR_S, 5.0) is None
    world.take(6 * FLOOR_S)
    assert world.stands()


@pytest.mark.parametrize("left", [1.0, 1.5, 2.2])
def test_a_queue_that_gets_shorter_when_less_is_sent_is_one(left: float) -> None:
    world = World()
    world.take(3 * FLOOR_S)
    world.queue.on_cut(world.rtt, world.now)
    world.take(3 * FLOOR_S, 0.2)
    assert world.take(left * FLOOR_S, 0.8) is None
    assert world.take(3 * FLOOR_S, 2 * YIELDED_S) is None
    assert world.stands()


def test_others_queue_that_was_taken_for_a_route_is_found_out_when_it_gets_shorter() -> None:
    world = World()
    world.take(3 * FLOOR_S)
    world.queue.on_cut(world.rtt, world.now)
    assert world.take(3 * FLOOR_S, YIELDED_S + 0.5) is FloorChange.ROSE
    assert world.take(2 * FLOOR_S) is FloorChange.FELL
    world.take(3 * FLOOR_S)
    assert world.stands()
