"""Limits how often something may happen: a burst at once, and then a rate per second."""

from __future__ import annotations


class TokenBucket:
    """A token bucket, full at first; `rate` tokens a second come back, up to `burst`. Times are monotonic seconds."""

    __slots__ = ("_at", "_burst", "_rate", "_tokens")

    def __init__(self, *, rate: float, burst: float, now: float) -> None:
        self._rate = rate
        self._burst = burst
        self._tokens = burst
        self._at = now

    def take(self, now: float, cost: float = 1.0) -> bool:
        """Take `cost` tokens; if there are too few, take nothing and return False."""
        self._tokens = min(self._burst, self._tokens + self._rate * max(0.0, now - self._at))
        self._at = max(self._at, now)
        if self._tokens < cost:
            return False
        self._tokens -= cost
        return True

    def fill(self, now: float) -> None:
        """Fill the bucket."""
        self._tokens, self._at = self._burst, max(self._at, now)

    def is_full(self, now: float) -> bool:
        """Return whether the bucket is full, like a new one."""
        return self._tokens + self._rate * max(0.0, now - self._at) >= self._burst
