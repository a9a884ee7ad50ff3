"""Notices that the host was suspended: meanwhile CLOCK_MONOTONIC stands still, and with it each of our timers."""

from __future__ import annotations

import functools
import time

NOTICED_S = 0.1
"""Shorter differences between the two clocks come from reading one after the other."""


boot_time = functools.partial(time.clock_gettime, time.CLOCK_BOOTTIME)
"""Returns the time since boot (s), that spent suspended included (clock_gettime(2))."""


class Suspension:
    """Compares the clock that stands still with the one that does not."""

    __slots__ = ("noticed_at_s",)

    def __init__(self, now: float, booted: float) -> None:
        """Begin at these readings of `time.monotonic` and `boot_time`."""
        self.noticed_at_s = booted - now + NOTICED_S
        """The host was suspended since the last look if the clocks differ by at least this much (s)."""

    def slept_s(self, now: float, booted: float) -> float:
        """Return how long it was suspended since the last call (s), from the same two clocks."""
        before_s = self.noticed_at_s - NOTICED_S
        self.noticed_at_s = booted - now + NOTICED_S
        return booted - now - before_s
