"""Keeps histograms and counts that forget: every sample's weight halves with each half-life.

Tables of them forget as well: names of robots and servers come and go without end, and not all can be kept.
"""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left
from itertools import accumulate
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from plr.controlplane.core.estimate.distribution import Distribution
from plr.controlplane.core.estimate.staleness import Silence
from plr.protos.base.histogram import BUCKETS, MAX_COUNT, MIDS, Histogram
from plr.protos.base.size_class import SIZE_CLASSES

if TYPE_CHECKING:
    from collections import OrderedDict
    from collections.abc import Callable

    from numpy.typing import NDArray

    from plr.controlplane.core.estimate.change_detection import ChangeWatch
    from plr.controlplane.core.estimate.staleness import HeardClock

_FORGOTTEN = 1e-9
"""Samples that together weigh less count as none: soon after, floats run out of range."""


class FadedCount:
    """A pair of counts, events and those of them that went wrong, fading with a half-life in seconds."""

    __slots__ = ("_all", "_at", "_bad", "_half_life_s")

    def __init__(self, half_life_s: float, now: float) -> None:
        self._half_life_s = half_life_s
        self._at = now
        self._all = 0.0
        self._bad = 0.0

    @property
    def at(self) -> float:
        """When something was last added."""
        return self._at

    def add(self, total: float, bad: float, now: float) -> None:
        """Count `total` events, `bad` of them wrong."""
        factor = math.exp2((self._at - now) / self._half_life_s)
        self._at = now
        self._all = self._all * factor + total
        self._bad = self._bad * factor + bad

    def weight(self, now: float) -> float:
        """Return how many events it is worth by now."""
        return self._all * math.exp2((self._at - now) / self._half_life_s)

    def rank(self) -> float:
        """Return the rank: of counts with the same half-life, the higher one is worth more events at any time."""
        return math.log2(self._all) + self._at / self._half_life_s if self._all else -math.inf

    def ratio(self) -> float:
        """Return the share of the wrong ones; NaN without events."""
        return self._bad / self._all if self._all else math.nan


class FadedShares:
    """How often each of a few kinds, numbered from 0, came recently; fading with a half-life in seconds."""

    __slots__ = ("_at", "_counts", "_half_life_s")

    def __init__(self, kinds: int, half_life_s: float, now: float) -> None:
        self._half_life_s = half_life_s
        self._at = now
        self._counts = [0.0] * kinds

    @property
    def at(self) -> float:
        """When something was last added."""
        return self._at

    def add(self, kind: int, count: float, now: float) -> None:
        """Count more of one kind."""
        factor = math.exp2((self._at - now) / self._half_life_s)
        self._at = now
        self._counts = [old * factor for old in self._counts]
        self._counts[kind] += count

    def shares(self, least: float) -> list[tuple[int, float]]:
        """Return (kind, share) of those that make up at least `least` of all; their shares sum to 1."""
        counts = self._counts
        limit = least * sum(counts)
        common = [(kind, count) for kind, count in enumerate(counts) if count and count >= limit]
        total = sum([count for _, count in common])
        return [(kind, count / total) for kind, count in common]


class FadedHistogram:
    """Weights of the buckets of `plr.protos.base.histogram` and of the lost, fading with a half-life in seconds.

    Called-off samples count for as long as they lasted: `distribution` follows Kaplan and Meier. With the clock of its
    group, a histogram fades faster while only others of the group are reported.
    """

    __slots__ = (
        *("_answered", "_at", "_called_off", "_counts", "_distribution", "_first", "_half_life_s", "_lost", "_silence"),
        *("_total", "_values"),
    )

    def __init__(self, half_life_s: float, now: float, clock: HeardClock | None = None) -> None:
        self._silence = Silence(clock)
        self._half_life_s = half_life_s
        self._at = now
        # Most histograms use a few dozen adjacent buckets; all buckets of a fleet would not fit a processor's cache.
        self._first = BUCKETS
        self._values = array("d")
        """Weights from the first bucket in use to the last: counting one up is as cheap as in a Python list ..."""
        self._counts: NDArray[np.float64] = np.zeros(0)
        """... and numpy computes on the same memory."""
        self._called_off: NDArray[np.float64] | None = None
        self._lost = 0.0
        self._total = 0.0
        self._distribution: Distribution | None = None
        self._answered: Distribution | None = None

    @property
    def at(self) -> float:
        """When something was last added."""
        return self._at

    def add(self, histogram: Histogram, now: float, called_off: Histogram | None = None) -> None:
        """Merge new samples, and those called off, by when they were."""
        factor = math.exp2((self._at - now) / self._half_life_s) * self._silence.end()
        self._at = now
        indices, counts = histogram.sparse
        lost = histogram.lost
        self._counts *= factor
        if indices:
            if indices[0] < self._first or indices[-1] - self._first >= len(self._values):
                self._make_room(indices[0], indices[-1] + 1)
            values, first = self._values, self._first
            for index, count in zip(indices, counts, strict=True):
                values[index - first] += count
        self._lost = self._lost * factor + lost
        ended = 0
        if called_off is not None and (ended := called_off.answered) and self._called_off is None:
            self._called_off = np.zeros(BUCKETS)
        if self._called_off is not None:
            self._called_off *= factor
            if called_off is not None and ended:
                self._called_off += called_off.counts
        self._total = self._total * factor + (sum(counts) + lost) + ended
        self._distribution = self._answered = None

    def _make_room(self, first: int, end: int) -> None:
        """Extend the range to the buckets from `first` to before `end`."""
        had_first, had_end = self._first, self._first + len(self._values)
        first, end = min(first, had_first), max(end, had_end) if self._values else end
        values = array("d", bytes(8 * (end - first)))
        values[had_first - first : had_first - first + len(self._values)] = self._values
        self._first, self._values, self._counts = first, values, np.frombuffer(values)

    def forget(self, kept: float) -> None:
        """Reduce everything counted to this share."""
        self._counts *= kept
        self._lost *= kept
        self._total *= kept
        if self._called_off is not None:
            self._called_off *= kept
        self._distribution = self._answered = None

    def held_against(self, new: Histogram, watch: ChangeWatch, now: float) -> Histogram | None:
        """Let a watch judge samples, before they are added, by what is known now."""
        kept = math.exp2((self._at - now) / self._half_life_s) * self._silence.kept()
        return watch.add(new, self.snapshot(), self._lost, max(kept, _FORGOTTEN), now)

    def weight(self, now: float) -> float:
        """Return how many samples it is worth by now, including the lost and those called off."""
        return self.aged(now) * self._silence.kept()

    def aged(self, now: float) -> float:
        """Return the same as if nothing of its group had been reported since."""
        return self._total * math.exp2((self._at - now) / self._half_life_s)

    def scaled(self, now: float, sample: int) -> Histogram:
        """Return the distribution as whole counts; an unfaded sample counts `sample`. Their total is limited to what
        fits a histogram even when those of all size classes are merged."""
        found = self.distribution()
        if found is None:
            return Histogram()
        scale = min(sample * self.weight(now), MAX_COUNT / (2 * SIZE_CLASSES))
        counts = np.rint(found.mass * scale).astype(np.int64)
        used = np.flatnonzero(counts)
        return Histogram.from_sparse(used.tolist(), counts[used].tolist(), round(found.never * scale))

    def lost_share(self) -> float:
        """Return the share of the lost; NaN without samples."""
        return self._lost / self._total if self._total > _FORGOTTEN else math.nan

    def snapshot(self) -> NDArray[np.float64]:
        """Return the present weights of the answered samples, for all `BUCKETS` buckets."""
        dense = np.zeros(BUCKETS)
        dense[self._first : self._first + len(self._counts)] = self._counts
        return dense

    def median(self) -> float:
        """Return the median of the answered samples, within 2 %; NaN without any."""
        answered = self.answered()
        return answered.median() if answered is not None else math.nan

    def median_once(self) -> float:
        """Return the same without caching anything, for callers that do not ask again soon."""
        reached = list(accumulate(self._values))
        if not reached or reached[-1] <= _FORGOTTEN:
            return math.nan
        return MIDS[self._first + bisect_left(reached, reached[-1] / 2)]

    def answered(self) -> Distribution | None:
        """Return the distribution of the answered samples alone; None without any."""
        if self._answered is None:
            total = self._answered_total()
            if total > _FORGOTTEN:
                self._answered = Distribution.of(self._counts / total, 0.0, first=self._first)
        return self._answered

    def distribution(self) -> Distribution | None:
        """Return the distribution of the samples; None without any.

        In each bucket, the share known to be slower is taken among all samples that got there (Kaplan and Meier 1958).
        Beyond the last answered sample, those called off count as never answered.
        """
        if self._distribution is None and self._total > _FORGOTTEN:
            self._distribution = self._known() if self._called_off is None else self._survived(self._called_off)
        return self._distribution

    def _answered_total(self) -> float:
        # Over all buckets, as numpy sums pairwise: the result does not depend on which of them are kept.
        return float(np.add.reduce(self.snapshot()))

    def _known(self) -> Distribution:
        total = self._answered_total() + self._lost
        if not self._values:
            return Distribution.of(np.zeros(BUCKETS), self._lost / total)
        return Distribution.of(self._counts / total, self._lost / total, first=self._first)

    def _survived(self, called_off: NDArray[np.float64]) -> Distribution:
        counts = self.snapshot()
        ended = counts + called_off
        there = ended[::-1].cumsum()[::-1] + self._lost
        hazard = np.divide(counts, there, out=np.zeros(BUCKETS), where=there > 0.0)
        slower = np.cumprod(1.0 - np.minimum(hazard, 1.0))
        before = np.concatenate(([1.0], slower[:-1]))
        return Distribution.of(before - slower, float(slower[-1]))


K = TypeVar("K")
V = TypeVar("V")

FORGET_S = 3600.0
"""Minimum time for which something no longer reported is kept: a robot back after a break finds its past."""

FORGET_HALF_LIVES = 30.0
"""Minimum in half-lives: of a billion samples one is left then."""


def forget_after_s(half_life_s: float) -> float:
    """Return how long something with this half-life is kept after the last addition."""
    return max(FORGET_S, FORGET_HALF_LIVES * half_life_s)


def forget_before(table: OrderedDict[K, V], since: float, at: Callable[[V], float]) -> None:
    """Remove entries older than `since` from a table that is in the order of `at`."""
    while table and at(next(iter(table.values()))) < since:
        table.popitem(last=False)
