"""Measures how long requests take, and how much that varies."""

from __future__ import annotations

import math


class ServiceTimes:
    """Mean and variance of service times at a server, and mean requests there: of all, or mostly of the newest."""

    __slots__ = ("_kept", "count", "mean_s", "out", "variance")

    def __init__(self, kept: float = math.inf) -> None:
        self._kept = kept
        """Each request has at least a weight of one over this in the means."""
        self.count = 0
        self.mean_s = 0.0
        self.variance = 0.0
        """Seconds squared."""
        self.out = 0.0
        """Mean number of requests at the server when one was sent, that one included."""

    def add(self, took_s: float, out: int = 1) -> None:
        """Add an answered request."""
        self.count = int(min(self.count + 1, self._kept))
        self.out += (out - self.out) / self.count
        off_s = took_s - self.mean_s
        self.mean_s += off_s / self.count
        self.variance = (1 - 1 / self.count) * (self.variance + off_s * off_s / self.count)

    @property
    def rate(self) -> float:
        """Answers per second by Little's law."""
        return self.out / self.mean_s

    @property
    def variation(self) -> float:
        """Variance divided by the square of the mean."""
        return self.variance / (self.mean_s * self.mean_s)
