"""Estimates how often the later copies of a request come too late as well when the first one misses.

A robot avoids a path that it sees fail, so most misses of its first copies are failures of all paths at once:
multiplying the misses of two paths underestimates them by far. Earlier requests tell more: how many missed at all,
beside how many first copies missed, of which a sample is measured. This remembers for long, as misses are few.
"""

from __future__ import annotations

import math

from plr.controlplane.core.estimate.fading import FadedCount
from plr.controlplane.core.estimate.posterior import USUAL_STREAK

HALF_LIFE_S = 600.0
"""As for interfaces that fail together: places change, carriers do not."""


class LateFate:
    """Misses of one robot's service. Times are monotonic seconds."""

    __slots__ = ("_first", "_requests")

    def __init__(self, now: float) -> None:
        self._first = FadedCount(HALF_LIFE_S, now)
        self._requests = FadedCount(HALF_LIFE_S, now)

    @property
    def at(self) -> float:
        """When something was last added."""
        return max(self._first.at, self._requests.at)

    def add_first(self, copies: float, missed: float, now: float) -> None:
        """Count first copies, each of which was equally likely to be measured."""
        self._first.add(copies, missed, now)

    def add_requests(self, requests: float, missed: float, now: float) -> None:
        """Count requests, and those of them that had no answer in time."""
        self._requests.add(requests, missed, now)

    def counts(self, now: float) -> tuple[float, float]:
        """Return how many first copies and how many requests missed, as independent ones: misses come in streaks."""
        ratio, missed = self._first.ratio(), self._requests.ratio()
        if math.isnan(ratio) or math.isnan(missed):
            return 0.0, 0.0
        worth = self._requests.weight(now) / USUAL_STREAK
        # A request answered in time another way may have had a first copy that missed; not the other way round.
        return worth * max(ratio, missed), worth * missed
