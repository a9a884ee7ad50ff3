"""Detects within a few answers that a server's times have changed.

A memory of a minute takes a minute to follow, and one of a few seconds knows a steady server badly. So new samples are
held against the whole memory: are they more likely under it, or as the beginning of something else, of which nothing is
expected but that it stays as it began (Polya's urn)? Sums of the log-likelihood ratio that do not fall back to 0 reveal
a change and when it began (CUSUM, Page 1954). Everything measured before it, times and outcomes, is then forgotten.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from plr.protos.base.histogram import BUCKETS, GROWTH

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from plr.protos.base.histogram import Histogram

_PER_BIN = round(math.log(2.0) / math.log(GROWTH))
"""Buckets of a histogram that count as one: times up to twice as long."""

_FIRST = np.arange(0, BUCKETS, _PER_BIN)
_BINS = len(_FIRST) + 1
"""Number of bins, including one for the lost."""

PRIOR_SAMPLES = 2.0
"""Pseudo-count spread evenly over the bins beside what was measured: a server hardly measured hardly changes."""

NEW_PRIOR_SAMPLES = 1.0
"""The same for what may have begun: its second sample is as likely to resemble the first as anything."""

MAX_EVIDENCE = 2.5
"""Upper limit for one sample: a server that once took long may have done so by chance, but not three times in a row."""

ENOUGH_EVIDENCE = 6.0
"""Logarithm of the likelihood ratio that is enough: a change is a few hundred times as likely."""

LEAST_S = 0.4
"""Minimum duration of a change; everything that waited behind one hiccup of a server is a single event."""

NEIGHBOURS_SHARE = 0.15
"""Share of a bin's expectation that goes to each of the next faster and the next slower bin: times spread."""

DRIFT = 0.3
"""Subtracted for each sample, so that business as usual does not look like a beginning."""

USUAL_SHARE = 0.2
"""Nothing new begins with a sample if this share of those before it took half to twice as long."""


class ChangeWatch:
    """Holds new samples against the caller's memory of old ones. Times are monotonic seconds."""

    __slots__ = ("_began", "_evidence", "_since", "accused")

    def __init__(self) -> None:
        self.accused = False
        """Whether the samples added last spoke for a change."""
        self._evidence = 0.0
        self._began = math.inf
        self._since: Histogram | None = None

    @property
    def suspects(self) -> bool:
        """Whether the last samples were odd, but too few yet to show a change."""
        return self._since is not None

    def add(
        self, new: Histogram, known: NDArray[np.float64], known_lost: float, kept: float, now: float
    ) -> Histogram | None:
        """Judge new samples by what is known without them, of which a share of `kept` still counts.

        Return what came since the change if there was one, else None. The caller then calls `settled` or `doubted`.
        """
        self.accused = False
        if self._since is None and _is_usual(new, known, known_lost, kept):
            return None
        expected = kept * _smooth(known, known_lost)
        expected = np.log((expected + PRIOR_SAMPLES / _BINS) / (expected.sum() + PRIOR_SAMPLES))
        counts = _binned(new.counts, new.lost)
        says = _log_begun(counts, self._since) - float(counts @ expected)
        gain = min(says, MAX_EVIDENCE * new.total) - DRIFT * new.total
        self._evidence += gain
        self.accused = gain > 0.0
        if self._evidence <= 0.0:
            self._evidence, self._since = 0.0, None
            if _is_usual(new, known, known_lost, kept):
                return None
        if self._since is None:
            self._since, self._began = new.copy(), now
        else:
            self._since.merge(new)
        if self._evidence < ENOUGH_EVIDENCE or now - self._began < LEAST_S:
            return None
        return self._since

    def settled(self) -> None:
        """Note that the change has been taken into account."""
        self._evidence, self._since = 0.0, None

    def doubted(self) -> None:
        """Note that the change is not believed yet: more of the same says no more than this did."""
        self._evidence = ENOUGH_EVIDENCE


def _is_usual(new: Histogram, known: NDArray[np.float64], known_lost: float, kept: float) -> bool:
    if new.lost:
        return False
    sums = np.add.reduce
    least = USUAL_SHARE * (float(sums(known)) + known_lost + PRIOR_SAMPLES / kept)
    return all(sums(known[max(0, bucket - _PER_BIN) : bucket + _PER_BIN + 1]) >= least for bucket in new.sparse[0])


def _log_begun(counts: NDArray[np.float64], since: Histogram | None) -> float:
    """Return the log-probability of these samples, one by one, given those since the change began."""
    begun = _smooth(since.counts, since.lost) if since is not None else np.zeros(_BINS)
    prior = NEW_PRIOR_SAMPLES / _BINS
    total = float(begun.sum()) + NEW_PRIOR_SAMPLES
    found = math.lgamma(total) - math.lgamma(total + float(counts.sum()))
    for number in np.flatnonzero(counts).tolist():
        there = float(begun[number]) + prior
        found += math.lgamma(there + float(counts[number])) - math.lgamma(there)
    return found


def _smooth(counts: NDArray[np.float64] | NDArray[np.int64], lost: float) -> NDArray[np.float64]:
    binned = _binned(counts, lost)
    times = binned[:-1]
    outer = NEIGHBOURS_SHARE * times
    times -= 2.0 * outer
    times[1:] += outer[:-1]
    times[:-1] += outer[1:]
    times[0] += outer[0]
    times[-1] += outer[-1]
    return binned


def _binned(counts: NDArray[np.float64] | NDArray[np.int64], lost: float) -> NDArray[np.float64]:
    return np.append(np.add.reduceat(counts, _FIRST), lost).astype(np.float64)
