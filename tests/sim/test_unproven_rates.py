"""A link's rate changes while only small requests are sent, too small to show it; then a large one comes."""

from __future__ import annotations

import pytest

from plr.sidecar.core.path.congestion.model_controller import INITIAL_WINDOW_BYTES, UNPROVEN_S
from tests.sim.test_paced_requests import MBIT, World

LARGE = 500_000
SMALL = 300


def unconfirmed(before: float, after: float, seconds: float = 5.0, small: int = SMALL) -> World:
    """A world whose rate was learned, and changed before so many seconds of small requests."""
    world = World(before, 0.025, deadline_s=2.0, lifetime_s=30.0)
    world.up.buffer_bytes = 4e6
    world.request(min(300_000, int(before / 4)), 6.0, hz=3)
    world.up.bytes_per_s = after
    world.request(small, seconds, hz=5)
    return world


def large(world: World, seconds: float) -> tuple[float, list[float]]:
    """How long one large request takes, and the small ones that are sent meanwhile, sorted."""
    world.up.longest_wait_s = 0.0
    world.mesh.calls += 1
    first = world.robot.submit(world.mesh.calls.to_bytes(4, "big") + bytes(LARGE))
    longest = world.up.longest_wait_s
    others = world.request(SMALL, seconds, hz=5)
    world.up.longest_wait_s = max(longest, world.up.longest_wait_s)
    (took,) = world.elapsed([first])
    elapsed = sorted(world.elapsed(others))
    assert len(elapsed) == len(others)
    return took, elapsed


@pytest.mark.audit("dp-6")
@pytest.mark.parametrize("seconds", [5.0, 60.0])
@pytest.mark.parametrize(("before", "after"), [(50, 1), (20, 1), (100, 2)])
def test_after_a_fall_the_modem_holds_no_more_than_on_an_unknown_path(
    before: float, after: float, seconds: float
) -> None:
    world = unconfirmed(before * MBIT, after * MBIT, seconds)
    assert world.control.rate.best > 0.8 * before * MBIT, "nothing showed the fall"
    took, others = large(world, 8.0)
    assert world.up.longest_wait_s < 1.1 * max(INITIAL_WINDOW_BYTES, UNPROVEN_S * before * MBIT) / (after * MBIT)
    assert others[len(others) // 2] < 0.15
    assert others[-1] < 1.2
    assert took < 1.15 * (LARGE / (after * MBIT) + 0.05)


@pytest.mark.audit("dp-6")
@pytest.mark.parametrize(("before", "after"), [(2, 20), (10, 100)])
def test_after_a_rise_a_large_request_soon_has_the_new_rate(before: float, after: float) -> None:
    took, _ = large(unconfirmed(before * MBIT, after * MBIT), 2.0)
    assert took < LARGE / (after * MBIT) + 0.05 + 0.2


@pytest.mark.parametrize("rate", [10, 50])
def test_a_rate_that_did_not_change_costs_a_large_request_one_round_trip(rate: float) -> None:
    took, _ = large(unconfirmed(rate * MBIT, rate * MBIT), 2.0)
    assert took < LARGE / (rate * MBIT) + 2 * 0.05 + 0.02


@pytest.mark.parametrize("size", [20_000, 120_000])
@pytest.mark.parametrize("gap_s", [0.2, 2.0])
def test_requests_that_confirm_the_rate_each_time_leave_at_once(size: int, gap_s: float) -> None:
    world = World(50 * MBIT, 0.025, deadline_s=2.0)
    world.request(size, 3.0, hz=5)
    elapsed = []
    for _ in range(10):
        elapsed += world.elapsed(world.request(size, 0.2, hz=5))
        world.request(SMALL, gap_s - 0.2, hz=10)
    assert max(elapsed) < size / (50 * MBIT) + 0.05 + 0.01
