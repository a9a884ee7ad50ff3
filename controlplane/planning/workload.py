"""What is sent through traces."""

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
    """How long a server works on a request: log-normal, by its median and its 99th percentile, in seconds."""

    median_s: float
    p99_s: float

    def draw(self, rng: random.Random) -> float:
        """One request's time."""
        return self.median_s * rng.lognormvariate(0.0, math.log(self.p99_s / self.median_s) / _P99)


@dataclass(frozen=True, slots=True)
class Workload:
    """Requests of one size at a steady rate."""

    request_bytes: int
    answer_bytes: int
    rate_hz: float
    compute: Compute


DEFAULT = Workload(request_bytes=10_000, answer_bytes=1000, rate_hz=10.0, compute=Compute(0.02, 0.04))
"""Unless said otherwise; what was recorded live has its own."""
