"""Keeps histograms and counts that forget: every sample's weight halves with each half-life.

Tables of them forget as well: names of robots and servers come and go without end, and must not all be kept.
"""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left
from itertools import accumulate
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from controlplane.core.estimate.distribution import Distribution
from controlplane.core.estimate.staleness import Silence
from protos.base.histogram import BUCKETS, MAX_COUNT, MIDS, Histogram
from protos.base.size_class import SIZE_CLASSES

if TYPE_CHECKING:
    from collections import OrderedDict
    from collections.abc import Callable

    from numpy.typing import NDArray

    from controlplane.core.estimate.change_detection import ChangeWatch
    from controlplane.core.estimate.staleness import HeardClock

_FORGOTTEN = 1e-9
"""Samples that together weigh less are none: a few steps on, floats run out of range."""


class FadedCount:
    """A pair of counts, events and those among them that went wrong, fading with a half-life in seconds."""

    __slots__ = ("_all", "_at", "_bad", "_half_life_s")

    def __init__(self, half_life_s: float, now: float) -> None:
        self._half_life_s = half_life_s
        self._at = now
        self._all = 0.0
        self._bad = 0.0

    @property
    def at(self) -> float:
        """When something was added last."""
        return self._at

    def add(self, total: float, bad: float, now: float) -> None:
        """Count `total` events, `bad` of them wrong."""
        factor = math.exp2((self._at - now) / self._half_life_s)
        self._at = now
        self._all = self._all * factor + total
        self._bad = self._bad * factor + bad

    def weight(self, now: float) -> float:
        """How many events it is worth by now."""
        return self._all * math.exp2((self._at - now) / self._half_life_s)

    def rank(self) -> float:
        """Of counts with the same half-life the one of higher rank is worth more events, at any time."""
        return math.log2(self._all) + self._at / self._half_life_s if self._all else -math.inf

    def ratio(self) -> float:
        """Share of the wrong ones; NaN without events."""
        return self._bad / self._all if self._all else math.nan


class FadedShares:
    """How often each of a few kinds came lately, numbered from 0; fading with a half-life in seconds."""

    __slots__ = ("_at", "_counts", "_half_life_s")

    def __init__(self, kinds: int, half_life_s: float, now: float) -> None:
        self._half_life_s = half_life_s
        self._at = now
        self._counts = [0.0] * kinds

    @property
    def at(self) -> float:
        """When something was added last."""
        return self._at

    def add(self, kind: int, count: float, now: float) -> None:
        """Count more of one kind."""
        factor = math.exp2((self._at - now) / self._half_life_s)
        self._at = now
        self._counts = [old * factor for old in self._counts]
        self._counts[kind] += count

    def shares(self, least: float) -> list[tuple[int, float]]:
        """(kind, share) of those that make up at least `least` of all; their shares sum up to 1."""
        counts = self._counts
        limit = least * sum(counts)
        common = [(kind, count) for kind, count in enumerate(counts) if count and count >= limit]
        total = sum([count for _, count in common])
        return [(kind, count / total) for kind, count in common]


class FadedHistogram:
    """Weights by bucket of `protos.base.histogram`, and of the lost, fading with a half-life in seconds.

    Samples that were called off count for as long as they lasted: `distribution` follows Kaplan and Meier. With the
    clock of its like they fade faster while only these are heard of.
    """

    __slots__ = (
        *("_answered", "_at", "_called_off", "_counts", "_distribution", "_first", "_half_life_s", "_lost", "_silence"),
        *("_total", "_values"),
    )

    def __init__(self, half_life_s: float, now: float, clock: HeardClock | None = None) -> None:
        self._silence = Silence(clock)
        self._half_life_s = half_life_s
        self._at = now
        # Most histograms use a few dozen buckets side by side; all of a fleet's would not stay in a processor's cache.
        self._first = BUCKETS
        self._values = array("d")
        """Weights from the first bucket in use to the last: one is counted up as in a list of Python's ..."""
        self._counts: NDArray[np.float64] = np.zeros(0)
        """... and numpy computes on the same memory."""
        self._called_off: NDArray[np.float64] | None = None
        self._lost = 0.0
        self._total = 0.0
        self._distribution: Distribution | None = None
        self._answered: Distribution | None = None

    @property
    def at(self) -> float:
        """When something was added last."""
        return self._at

    def add(self, histogram: Histogram, now: float, called_off: Histogram | None = None) -> None:
        """Merge new samples, and of those called off when they were."""
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
        """Keep the buckets from `first` to before `end` as well."""
        had_first, had_end = self._first, self._first + len(self._values)
        first, end = min(first, had_first), max(end, had_end) if self._values else end
        values = array("d", bytes(8 * (end - first)))
        values[had_first - first : had_first - first + len(self._values)] = self._values
        self._first, self._values, self._counts = first, values, np.frombuffer(values)

    def forget(self, kept: float) -> None:
        """Only this share of what was counted still counts."""
        self._counts *= kept
        self._lost *= kept
        self._total *= kept
        if self._called_off is not None:
            self._called_off *= kept
        self._distribution = self._answered = None

    def held_against(self, new: Histogram, watch: ChangeWatch, now: float) -> Histogram | None:
        """Let a watch judge samples that are still to be added by what is known now."""
        kept = math.exp2((self._at - now) / self._half_life_s) * self._silence.kept()
        return watch.add(new, self.snapshot(), self._lost, max(kept, _FORGOTTEN), now)

    def weight(self, now: float) -> float:
        """How many samples it is worth by now, the lost and those called off included."""
        return self.aged(now) * self._silence.kept()

    def aged(self, now: float) -> float:
        """The same, were its like not heard of since."""
        return self._total * math.exp2((self._at - now) / self._half_life_s)

    def scaled(self, now: float, sample: int) -> Histogram:
        """The distribution as whole counts, where a sample that has not faded counts `sample`; no more of them than fit
        a histogram, also when those of all size classes are put together."""
        found = self.distribution()
        if found is None:
            return Histogram()
        scale = min(sample * self.weight(now), MAX_COUNT / (2 * SIZE_CLASSES))
        counts = np.rint(found.mass * scale).astype(np.int64)
        used = np.flatnonzero(counts)
        return Histogram.from_sparse(used.tolist(), counts[used].tolist(), round(found.never * scale))

    def lost_share(self) -> float:
        """Share of the lost; NaN without samples."""
        return self._lost / self._total if self._total > _FORGOTTEN else math.nan

    def snapshot(self) -> NDArray[np.float64]:
        """Weights of the answered samples by bucket, `BUCKETS` of them, as they are now."""
        dense = np.zeros(BUCKETS)
        dense[self._first : self._first + len(self._counts)] = self._counts
        return dense

    def median(self) -> float:
        """Median of the answered samples, within 2 %; NaN without any."""
        answered = self.answered()
        return answered.median() if answered is not None else math.nan

    def median_once(self) -> float:
        """The same, where nobody asks again soon: nothing is kept for that."""
        reached = list(accumulate(self._values))
        if not reached or reached[-1] <= _FORGOTTEN:
            return math.nan
        return MIDS[self._first + bisect_left(reached, reached[-1] / 2)]

    def answered(self) -> Distribution | None:
        """The answered samples alone; None without any."""
        if self._answered is None:
            total = self._answered_total()
            if total > _FORGOTTEN:
                self._answered = Distribution.of(self._counts / total, 0.0, first=self._first)
        return self._answered

    def distribution(self) -> Distribution | None:
        """What the samples tell; None without any.

        At the end of each bucket the share that is slower is that of those known to be, among all that got there
        (Kaplan and Meier 1958). Beyond the last that was answered, what was called off counts as never answered.
        """
        if self._distribution is None and self._total > _FORGOTTEN:
            self._distribution = self._known() if self._called_off is None else self._survived(self._called_off)
        return self._distribution

    def _answered_total(self) -> float:
        # Over all buckets, as numpy sums up pairwise: the figure does not depend on which of them are kept.
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
"""At least so long is kept what is not reported any more: who is back after a break finds its past."""

FORGET_HALF_LIVES = 30.0
"""And for so many half-lives: of a billion samples one is left then."""


def forget_after_s(half_life_s: float) -> float:
    """How long what fades with this half-life is kept after it was added to last."""
    return max(FORGET_S, FORGET_HALF_LIVES * half_life_s)


def forget_before(table: OrderedDict[K, V], since: float, at: Callable[[V], float]) -> None:
    """Take out of a table, which is in the order of `at`, what is older."""
    while table and at(next(iter(table.values()))) < since:
        table.popitem(last=False)
