"""How often a fleet reports, by its size and the control plane's load."""

from __future__ import annotations

import pytest

from plr.controlplane.core.overload.pacing import GROWTH, MAX_INTERVAL_S, REPORTS_PER_LEASE, WORTH_TELLING, Pacing

pytestmark = pytest.mark.audit("ops-18")


@pytest.fixture
def pacing() -> Pacing:
    return Pacing(interval_s=0.5, lease_s=5.0)


@pytest.mark.parametrize(
    ("sidecars", "interval_s"), [(0, 0.5), (10, 0.5), (100, 1.77), (1000, 6.29), (4000, 10.0), (10_000, 10.0)]
)
def test_the_interval_follows_the_number(pacing: Pacing, sidecars: int, interval_s: float) -> None:
    pacing.follow(sidecars, 0.0)
    assert pacing.interval_s == pytest.approx(interval_s, rel=0.01)
    assert pacing.lease_s == pytest.approx(max(5.0, REPORTS_PER_LEASE * interval_s), rel=0.01)


def test_one_that_comes_changes_nothing_worth_telling(pacing: Pacing) -> None:
    told = set()
    for sidecars in range(1, 4001):
        pacing.follow(sidecars, 0.0)
        told.add(pacing.interval_s)
        wanted = min(0.5 * (max(sidecars, 10) / 10) ** GROWTH, MAX_INTERVAL_S)
        assert 1 / WORTH_TELLING <= pacing.interval_s / wanted <= WORTH_TELLING
    assert len(told) < 20


def test_a_busy_control_plane_is_told_less_and_later_as_much_again(pacing: Pacing) -> None:
    for _ in range(60):
        pacing.follow(100, 0.0, 0.9)
    assert 3.0 < pacing.interval_s <= MAX_INTERVAL_S
    for _ in range(60):
        pacing.follow(100, 0.0, 0.1)
    assert pacing.interval_s == pytest.approx(1.77, rel=WORTH_TELLING - 1)


def test_what_is_over_in_two_seconds_stretches_nothing(pacing: Pacing) -> None:
    for busy in (1.0, 1.0, 0.1, 0.1):
        pacing.follow(10, 0.0, busy)
    assert pacing.interval_s == 0.5


def test_a_longer_configured_interval_is_never_shortened() -> None:
    pacing = Pacing(interval_s=30.0, lease_s=120.0)
    pacing.follow(4000, 0.0, 0.9)
    assert (pacing.interval_s, pacing.lease_s) == (30.0, 120.0)


def test_attempts_to_come_back_are_as_far_apart_as_the_fleet_needs(pacing: Pacing) -> None:
    found = []
    for sidecars in (1, 300, 10_000):
        pacing.follow(sidecars, 0.0)
        found.append(pacing.reconnect_max_s)
    assert found == [1.0, 2.0, 10.0]


def test_a_fleet_that_comes_is_told_seldom_and_in_the_end_exactly(pacing: Pacing) -> None:
    """A thousand in ten seconds, each of which is told when it comes and then whenever that is worth it."""
    told: list[float] = []
    messages = 0
    for sidecars in range(1, 1001):
        now = sidecars / 100.0
        pacing.follow(sidecars, now)
        told.append(pacing.interval_s)
        messages += 1
        for place, told_s in enumerate(told):
            if sidecars % 100 == place % 100 and pacing.worth_telling(told_s, now):  # each speaks once a second
                told[place] = pacing.interval_s
                messages += 1
    assert all(0.4 < told_s / pacing.interval_s < 2.0 for told_s in told)
    assert messages < 2200
    assert all(pacing.worth_telling(told_s, 30.0) == (told_s != pacing.interval_s) for told_s in told)
