"""Robot side: how long a fallback takes for a request, learned from its own answers."""

from __future__ import annotations

import math
from collections import deque

WINDOW = 128
"""Answers remembered, however old: the robot's processor is the same tomorrow."""
QUANTILE = 0.98
"""So many of the requests are to be answered within what is expected; 49 answers make it known."""
SPARE_UNTIL_KNOWN = 1.5
"""Until then: the longest time seen, times this."""


class FallbackTimes:
    """Seconds that one request took, as if it had been alone: what it waited for others is not counted."""

    __slots__ = ("_configured_s", "_free_since", "_seen_s")

    def __init__(self, configured_s: float | None) -> None:
        """`configured_s`: what the user promises in place of what is measured."""
        self._configured_s = configured_s
        self._seen_s: deque[float] = deque(maxlen=WINDOW)
        self._free_since = -math.inf

    def begun_at(self, called_at: float) -> float:
        """When a request that was called then begins to run, if the fallback has answered those before it."""
        return max(called_at, self._free_since)

    def note(self, called_at: float, answered_at: float) -> None:
        """It answered."""
        self._seen_s.append(answered_at - self.begun_at(called_at))
        self._free_since = answered_at

    def expected_s(self) -> float | None:
        """Seconds within which it will answer; None while nothing is known."""
        if self._configured_s is not None:
            return self._configured_s
        if not self._seen_s:
            return None
        rank = math.ceil(QUANTILE * (len(self._seen_s) + 1))
        if rank > len(self._seen_s):
            return max(self._seen_s) * SPARE_UNTIL_KNOWN
        return sorted(self._seen_s)[rank - 1]
