"""Histograms and counts that forget: every sample's weight halves with each half-life that passes."""

from __future__ import annotations

import math
from bisect import bisect_right
from typing import TYPE_CHECKING

import numpy as np

from protos.histogram import BUCKETS, EDGES, MAX_S, MIDS, Histogram

if TYPE_CHECKING:
    from numpy.typing import NDArray

_EDGES = np.array(EDGES)
_MIDS = np.array(MIDS)


class FadedCount:
    """A pair of counts, events and those among them that went wrong, fading with a half-life in seconds."""

    __slots__ = ("_all", "_at", "_bad", "_half_life_s")

    def __init__(self, half_life_s: float, now: float) -> None:
        self._half_life_s = half_life_s
        self._at = now
        self._all = 0.0
        self._bad = 0.0

    def add(self, total: float, bad: float, now: float) -> None:
        """Count `total` events, `bad` of them wrong."""
        factor = math.exp2((self._at - now) / self._half_life_s)
        self._at = now
        self._all = self._all * factor + total
        self._bad = self._bad * factor + bad

    def weight(self, now: float) -> float:
        """How many events it is worth by now."""
        return self._all * math.exp2((self._at - now) / self._half_life_s)

    def ratio(self) -> float:
        """Share of the wrong ones; NaN without events."""
        return self._bad / self._all if self._all else math.nan


class FadedHistogram:
    """Weights by bucket of `protos.histogram`, and of the lost, fading with a half-life in seconds."""

    __slots__ = ("_at", "_counts", "_half_life_s", "_lost")

    def __init__(self, half_life_s: float, now: float) -> None:
        self._half_life_s = half_life_s
        self._at = now
        self._counts: NDArray[np.float64] = np.zeros(BUCKETS)
        self._lost = 0.0

    def add(self, histogram: Histogram, now: float) -> None:
        """Merge new samples."""
        factor = math.exp2((self._at - now) / self._half_life_s)
        self._at = now
        self._counts *= factor
        self._lost *= factor
        indices, counts, lost = histogram.to_sparse()
        self._counts[indices] += counts
        self._lost += lost

    def weight(self, now: float) -> float:
        """How many samples it is worth by now, the lost included."""
        return float(self._counts.sum() + self._lost) * math.exp2((self._at - now) / self._half_life_s)

    def scaled(self, now: float, sample: int) -> Histogram:
        """As a histogram of whole counts, where a sample that has not faded counts `sample`."""
        scale = sample * math.exp2((self._at - now) / self._half_life_s)
        counts = np.rint(self._counts * scale).astype(np.int64)
        used = np.flatnonzero(counts)
        return Histogram.from_sparse(used.tolist(), counts[used].tolist(), round(self._lost * scale))

    def fraction_over(self, seconds: float) -> float:
        """Share of all samples slower than `seconds`, the lost included; NaN without samples."""
        total = float(self._counts.sum()) + self._lost
        if total <= 0.0:
            return math.nan
        return (self._over(seconds) + self._lost) / total

    def _over(self, seconds: float) -> float:
        index = bisect_right(EDGES, seconds)
        over = float(self._counts[index + 1 :].sum())
        if index == BUCKETS - 1:
            return over + float(self._counts[index])
        low = EDGES[index - 1] if index else 0.0
        share = min(1.0, (EDGES[index] - seconds) / (EDGES[index] - low))
        return over + share * float(self._counts[index])

    def lost_share(self) -> float:
        """Share of the lost; NaN without samples."""
        total = float(self._counts.sum()) + self._lost
        return self._lost / total if total > 0.0 else math.nan

    def median(self) -> float:
        """Median of the answered samples, within 2 %; NaN without any."""
        cumulated = self._counts.cumsum()
        if cumulated[-1] <= 0.0:
            return math.nan
        return float(_MIDS[int(np.searchsorted(cumulated, cumulated[-1] / 2))])

    def shares(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Values in seconds and their shares among the answered samples; both empty without any."""
        used = np.flatnonzero(self._counts)
        weights = self._counts[used]
        return _MIDS[used], weights / weights.sum() if used.size else weights

    def shares_over(self, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """For each of `seconds`, the share of answered samples that are slower; at least one sample needed."""
        tail = self._counts[::-1].cumsum()[::-1]
        edges = np.concatenate(([0.0], _EDGES))
        over: NDArray[np.float64] = np.interp(seconds, edges, tail / tail[0])
        # The overflow bucket has no upper edge: past its lower one it stays over, below zero everything is.
        over = np.where(seconds >= MAX_S, tail[-1] / tail[0], over)
        result: NDArray[np.float64] = np.where(seconds <= 0.0, 1.0, over)
        return result


def sum_exceeds(first: FadedHistogram, second: FadedHistogram | None, seconds: float, *, times: float = 1.0) -> float:
    """P(times x A + B > seconds) for independent answered samples A of `first` and B of `second`.

    Without samples in `second` B is 0; NaN without any in `first`.
    """
    values, shares = first.shares()
    if not values.size:
        return math.nan
    left = seconds - times * values
    if second is None or not second.shares()[0].size:
        return float(shares[left < 0.0].sum())
    return float(shares @ second.shares_over(left))
