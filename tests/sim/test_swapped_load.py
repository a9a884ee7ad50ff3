"""Servers swap load: the mapping leaves the one that got busy within seconds, whatever it knew of the others."""

from __future__ import annotations

from bench.matcher.swaps import SWAPS, Scene, swap

FOLLOWED_S = 5.0
AT_WORST_S = 12.0
LATER = 2
"""Swaps, of all, that may take longer: whether a server that was busy a moment ago still is must be tried."""
SEEDS = range(3)
SCENES = (
    Scene((0.05,), 2),
    # The busy one of two servers is left to the worse interface.
    Scene((0.02, 0.2), 2),
    Scene((0.05, 0.05), 3),
    # Nothing else ever misses.
    Scene((0.0, 0.0), 3),
)


def test_the_mapping_follows_load_that_moves_on() -> None:
    took = sorted(found.follow_s for scene in SCENES for seed in SEEDS for found in swap(scene, seed))
    assert len(took) == len(SCENES) * len(SEEDS) * SWAPS
    assert took[-LATER - 1] <= FOLLOWED_S
    assert took[-1] <= AT_WORST_S
