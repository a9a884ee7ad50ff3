"""Distributions of latencies over the buckets of `protos.histogram`, and how likely the sum of two is too slow."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from protos.histogram import BUCKETS, EDGES, MAX_S, MIDS

if TYPE_CHECKING:
    from numpy.typing import NDArray

_LOWER_EDGES = np.concatenate(([0.0], EDGES))
_MIDS = np.array(MIDS)
_ROUNDING = 1e-9
"""What sums of probabilities may be off by: half of the samples is half, whatever was added in between."""


@dataclass(frozen=True, slots=True)
class Distribution:
    """Probabilities of the buckets; what is left to 1 is that there never is an answer. Times are seconds."""

    mass: NDArray[np.float64]
    tail: NDArray[np.float64]
    """For each bucket the probability of more than its lower edge."""

    @classmethod
    def of(cls, mass: NDArray[np.float64], never: float) -> Distribution:
        """From the buckets' probabilities and that of no answer, which together are 1."""
        return cls(mass, mass[::-1].cumsum()[::-1] + never)

    @classmethod
    def mixed(cls, first: Distribution, share: float, second: Distribution) -> Distribution:
        """`first` with probability `share`, else `second`."""
        return cls(
            share * first.mass + (1.0 - share) * second.mass,
            share * first.tail + (1.0 - share) * second.tail,
        )

    @property
    def never(self) -> float:
        """Probability of no answer."""
        return max(0.0, float(self.tail[-1] - self.mass[-1]))

    def median(self) -> float:
        """Median within 2 %; inf if an answer is less likely than none."""
        slower = np.flatnonzero(self.tail <= 0.5 + _ROUNDING)
        index = int(slower[0]) - 1 if slower.size else BUCKETS - 1
        return MIDS[index] if index < BUCKETS - 1 or self.never <= 0.5 + _ROUNDING else math.inf

    def over(self, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """P(X > s) for each s, linear inside a bucket; the overflow bucket is over whatever there is."""
        over: NDArray[np.float64] = np.interp(seconds, _LOWER_EDGES, self.tail)
        over[seconds >= MAX_S] = self.tail[-1]
        over[seconds < 0.0] = 1.0
        return over

    def sum_exceeds(self, other: Distribution | None, seconds: float) -> float:
        """P(A + B > seconds) for an A of this distribution and a B of the other, independent; B is 0 without one."""
        return float(self.sums_exceed(other, np.array([seconds]))[0])

    def sums_exceed(self, other: Distribution | None, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """The same for each of some times."""
        if other is None:
            return self.over(seconds)
        used = np.flatnonzero(self.mass)
        exceeds: NDArray[np.float64] = other.over(seconds[:, np.newaxis] - _MIDS[used]) @ self.mass[used]
        return exceeds + self.never
