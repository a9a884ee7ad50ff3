"""Describes the requests that are sent through traces."""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import random

_P99 = NormalDist().inv_cdf(0.99)


@dataclass(frozen=True, slots=True)
class Compute:
    """Computing time of a request: log-normal, given by its median and 99th percentile, in seconds."""

    median_s: float
    p99_s: float

    def draw(self, rng: random.Random) -> float:
        """Draw the computing time of one request."""
        return self.median_s * rng.lognormvariate(0.0, math.log(self.p99_s / self.median_s) / _P99)


@dataclass(frozen=True, slots=True)
class Workload:
    """Requests of one size at a steady rate."""

    request_bytes: int
    answer_bytes: int
    rate_hz: float
    compute: Compute


DEFAULT = Workload(request_bytes=10_000, answer_bytes=1000, rate_hz=10.0, compute=Compute(0.02, 0.04))
"""Used unless options say otherwise; a live recording has its own workload."""
