from __future__ import annotations

import pytest

from plr.sidecar.core.path.congestion.loss_ceiling import CUT, LEAST_BYTES, MEMORY_S, LossCeiling
from plr.sidecar.core.path.congestion.rtt import RttEstimator
from plr.sidecar.core.path.congestion.units import DATAGRAM_BYTES

FLOOR_S = 0.050
IN_FLIGHT = 100 * DATAGRAM_BYTES
WANTED = 2.0 * IN_FLIGHT


class World:
    """A ceiling, and the round trips it is given."""

    def __init__(self, *, lost_first: int = 0) -> None:
        self.ceiling = LossCeiling()
        self.rtt = RttEstimator()
        self.now = 0.0
        self.round(FLOOR_S, lost=lost_first)

    def round(self, rtt_s: float, *, lost: int = 0, acked: int = 100) -> bool:
        """One round trip with so many datagrams acknowledged and lost; whether that cut the ceiling."""
        self.ceiling.on_sent(IN_FLIGHT)
        for _ in range(acked):
            self.now += rtt_s / acked
            self.rtt.sample(rtt_s, self.now)
            self.ceiling.on_acked(DATAGRAM_BYTES, rtt_s, self.rtt, WANTED, self.now)
        cut = bool(lost) and self.ceiling.on_lost(lost * DATAGRAM_BYTES, self.now, 0, self.rtt, self.now)
        self.ceiling.end_round(self.rtt, self.now)
        return cut


def test_a_loss_without_a_queue_is_the_radios() -> None:
    world = World()
    assert not any(world.round(FLOOR_S, lost=5) for _ in range(20))
    assert world.ceiling.bytes is None


def test_a_loss_with_a_queue_cuts() -> None:
    world = World()
    world.round(2 * FLOOR_S)
    assert world.round(2 * FLOOR_S, lost=1)
    assert world.ceiling.bytes == pytest.approx(CUT * IN_FLIGHT)


def test_below_a_full_queue_a_single_loss_is_the_radios_but_several_cut() -> None:
    world = World()
    world.round(3 * FLOOR_S)
    world.round(2 * FLOOR_S)
    assert not world.round(2 * FLOOR_S, lost=1)
    assert world.round(2 * FLOOR_S, lost=4)


def test_what_the_first_burst_lost_is_not_usual() -> None:
    world = World(lost_first=15)
    world.round(2 * FLOOR_S)
    assert world.round(2 * FLOOR_S, lost=1)


def test_what_a_cut_was_made_for_is_not_usual() -> None:
    world = World()
    assert world.round(FLOOR_S, lost=30)
    world.round(2 * FLOOR_S)
    assert world.round(2 * FLOOR_S, lost=1)


def test_what_is_usual_is_forgotten_where_a_queue_always_stands() -> None:
    world = World()
    for _ in range(20):
        world.round(FLOOR_S, lost=5)
    until = world.now + MEMORY_S + 1.0
    while world.now < until:
        world.round(2 * FLOOR_S)
    assert world.round(2 * FLOOR_S, lost=1)


def test_with_a_queue_the_usual_loss_cuts_nothing_but_more_does() -> None:
    world = World()
    for _ in range(20):
        world.round(FLOOR_S, lost=5)
    world.round(2 * FLOOR_S)
    assert not world.round(2 * FLOOR_S, lost=6)
    assert world.round(2 * FLOOR_S, lost=15)


def test_heavy_loss_cuts_without_a_queue_and_is_never_usual() -> None:
    world = World()
    assert world.round(FLOOR_S, lost=50)
    assert world.round(FLOOR_S, lost=50)


def test_round_trips_that_vary_are_no_queue() -> None:
    world = World()
    for step in range(200):
        world.now += 0.01
        world.rtt.sample(FLOOR_S * (1 + 0.25 * (step % 3)), world.now)
        world.ceiling.on_acked(DATAGRAM_BYTES, world.rtt.latest, world.rtt, WANTED, world.now)
        assert not world.ceiling.on_lost(DATAGRAM_BYTES if step % 50 == 0 else 0, world.now, 0, world.rtt, world.now)


def test_what_left_before_a_cut_does_not_cut_again() -> None:
    world = World()
    world.round(2 * FLOOR_S)
    assert world.round(2 * FLOOR_S, lost=1)
    cut_at = world.now
    assert not world.ceiling.on_lost(DATAGRAM_BYTES, cut_at - 0.01, 0, world.rtt, cut_at + 0.01)
    assert world.ceiling.on_lost(DATAGRAM_BYTES, cut_at + 0.005, 0, world.rtt, cut_at + 0.1)


def test_cuts_never_go_below_the_least() -> None:
    world = World()
    world.round(2 * FLOOR_S)
    for _ in range(50):
        world.round(2 * FLOOR_S, lost=1)
        for _ in range(5):
            world.round(1.5 * FLOOR_S)  # it gets shorter: it is a queue
        world.round(2 * FLOOR_S)
    assert world.ceiling.bytes is not None
    assert world.ceiling.bytes >= LEAST_BYTES


def test_a_route_that_got_longer_and_lossier_at_one_moment_has_no_ceiling_for_long() -> None:
    world = World()
    cuts = [world.round(3 * FLOOR_S, lost=3) for _ in range(100)]
    assert any(cuts[:5])
    assert not any(cuts[20:])
    assert world.ceiling.bytes is None


def test_it_grows_back_and_is_forgotten_when_it_no_longer_limits() -> None:
    world = World()
    world.round(2 * FLOOR_S)
    world.round(2 * FLOOR_S, lost=1)
    before = world.ceiling.bytes
    seen = []
    while world.ceiling.bytes is not None:
        seen.append(world.ceiling.bytes)
        world.round(FLOOR_S)
        assert world.now < 60
    assert before is not None
    assert seen == sorted(seen)
    assert max(seen) > 1.5 * IN_FLIGHT
