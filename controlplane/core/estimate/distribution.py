"""Represents latency distributions in the buckets of `plr.protos.base.histogram`, and how likely a sum is too slow."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from plr.protos.base.histogram import BUCKETS, EDGES, MAX_S, MIDS

if TYPE_CHECKING:
    from numpy.typing import NDArray

_LOWER_EDGES = np.concatenate(([0.0], EDGES))
_MIDS = np.array(MIDS)
_ROUNDING = 1e-9
"""Possible error in sums of probabilities: half of the samples is half, whatever was added in between."""


class Distribution:
    """Probabilities of the buckets; the rest to 1 is the probability of no answer. Times are seconds.

    It is immutable and keeps only the buckets from the first to the last that may be in use.
    """

    __slots__ = ("_first", "_mass", "_used", "never", "tail")

    def __init__(self, first: int, mass: NDArray[np.float64], tail: NDArray[np.float64]) -> None:
        self._first = first
        self._mass = mass
        """Probabilities from that bucket on."""
        self.tail = tail
        """For each of these buckets, and the next one if there is one, the probability of more than its lower edge."""
        self.never = max(0.0, float(tail[-1] - mass[-1]) if first + len(mass) == BUCKETS else float(tail[-1]))
        """Probability of no answer."""
        self._used: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None

    @classmethod
    def of(cls, mass: NDArray[np.float64], never: float, *, first: int = 0) -> Distribution:
        """Make it from the probabilities of buckets, from `first` on, and that of no answer, which together are 1."""
        tail = np.empty(min(len(mass) + 1, BUCKETS - first))
        tail[-1] = 0.0
        np.cumsum(mass[::-1], out=tail[len(mass) - 1 :: -1])
        tail += never
        return cls(first, mass, tail)

    @classmethod
    def mixed(cls, first: Distribution, share: float, second: Distribution) -> Distribution:
        """Return the mixture: `first` with probability `share`, else `second`."""
        start = min(first._first, second._first)
        end = max(first._first + len(first._mass), second._first + len(second._mass))
        (mass, tail), (other_mass, other_tail) = first._within(start, end), second._within(start, end)
        return cls(start, share * mass + (1.0 - share) * other_mass, share * tail + (1.0 - share) * other_tail)

    def _within(self, start: int, end: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return mass and tail over a larger range of buckets."""
        mass = np.zeros(end - start)
        tail = np.full(min(end + 1, BUCKETS) - start, self.tail[-1])
        before = self._first - start
        mass[before : before + len(self._mass)] = self._mass
        tail[:before] = self.tail[0]
        tail[before : before + len(self.tail)] = self.tail
        return mass, tail

    @property
    def mass(self) -> NDArray[np.float64]:
        """Probabilities of all `BUCKETS` buckets."""
        return self._within(0, BUCKETS)[0]

    @property
    def used(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Probabilities of the buckets that have any, and the times that stand for these buckets."""
        if self._used is None:
            used = self._mass.nonzero()[0]
            self._used = self._mass[used], _MIDS[used + self._first]
        return self._used

    def median(self) -> float:
        """Return the median within 2 %; inf if an answer is less likely than none."""
        slower = (self.tail <= 0.5 + _ROUNDING).nonzero()[0]
        index = int(slower[0]) + self._first - 1 if slower.size else BUCKETS - 1
        return MIDS[index] if index < BUCKETS - 1 or self.never <= 0.5 + _ROUNDING else math.inf

    def over(self, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return P(X > s) for each s, linear inside a bucket; the overflow bucket exceeds every s."""
        over = self._between(seconds)
        over[seconds >= MAX_S] = self.tail[-1]
        over[seconds < 0.0] = 1.0
        return over

    def _between(self, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the same for 0 <= s < MAX_S."""
        tail = self.tail
        over: NDArray[np.float64] = np.interp(seconds, _LOWER_EDGES[self._first : self._first + len(tail)], tail)
        return over

    def sum_exceeds(self, other: Distribution | None, seconds: float) -> float:
        """Return P(A + B > seconds) for independent A of this and B of the other distribution; without other, B is
        0."""
        if other is None:
            return float(self.over(np.array([seconds]))[0])
        mass, took = self.used
        if not len(took):
            return self.never
        left = seconds - took
        # The shortest time leaves the most.
        usual = left[0] < MAX_S and left[-1] >= 0.0
        return float(mass @ (other._between(left) if usual else other.over(left))) + self.never

    def sums_exceed(self, other: Distribution | None, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the same for each of several times."""
        if other is None:
            return self.over(seconds)
        mass, took = self.used
        exceeds: NDArray[np.float64] = other.over(seconds[:, np.newaxis] - took) @ mass
        return exceeds + self.never
