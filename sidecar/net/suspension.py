"""Notices that the host was suspended: meanwhile CLOCK_MONOTONIC stands still, and with it each of our timers."""

from __future__ import annotations

import time

NOTICED_S = 0.1
"""Shorter differences between the two clocks come from reading one after the other."""


def boot_time() -> float:
    """Return the time since boot (s), that spent suspended included (clock_gettime(2), CLOCK_BOOTTIME)."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class Suspension:
    """Compares the clock that stands still with the one that does not."""

    __slots__ = ("_ahead_s",)

    def __init__(self, now: float, booted: float) -> None:
        """Begin at these readings of `time.monotonic` and `boot_time`."""
        self._ahead_s = booted - now

    def slept_s(self, now: float, booted: float) -> float:
        """Return how long the host was suspended since the last call (s), from the same two clocks."""
        slept_s = booted - now - self._ahead_s
        if slept_s < NOTICED_S:
            return 0.0
        self._ahead_s += slept_s
        return slept_s
