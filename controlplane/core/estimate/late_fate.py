"""How often the copies that follow a first one that misses come too late as well.

A robot avoids a path that it sees fail, so what its first copies miss is mostly what fails on all paths at once: to
multiply the misses of two paths tells far too little. What became of earlier requests tells it: how many missed at all,
beside how many first copies missed, of which a sample is measured. This remembers for long, as misses are few.
"""

from __future__ import annotations

import math

from controlplane.core.estimate.fading import FadedCount
from controlplane.core.estimate.posterior import USUAL_STREAK

HALF_LIFE_S = 600.0
"""As of interfaces that fail together: places change, carriers do not."""


class LateFate:
    """Of one robot's service. Times are monotonic seconds."""

    __slots__ = ("_first", "_requests")

    def __init__(self, now: float) -> None:
        self._first = FadedCount(HALF_LIFE_S, now)
        self._requests = FadedCount(HALF_LIFE_S, now)

    @property
    def at(self) -> float:
        """When something was added last."""
        return max(self._first.at, self._requests.at)

    def add_first(self, copies: float, missed: float, now: float) -> None:
        """Count first copies, of which each would have been measured with the same probability."""
        self._first.add(copies, missed, now)

    def add_requests(self, requests: float, missed: float, now: float) -> None:
        """Count requests, and those of them that had no answer in time."""
        self._requests.add(requests, missed, now)

    def counts(self, now: float) -> tuple[float, float]:
        """First copies that missed and requests that missed, in independent ones: misses come in streaks."""
        ratio, missed = self._first.ratio(), self._requests.ratio()
        if math.isnan(ratio) or math.isnan(missed):
            return 0.0, 0.0
        worth = self._requests.weight(now) / USUAL_STREAK
        # Of requests that were answered in time another way, the first copy may have missed; not the other way round.
        return worth * max(ratio, missed), worth * missed
