"""Notices that a server's times are not what they were, within a few answers.

A memory of a minute takes a minute to follow, and one of a few seconds knows a steady server badly. So what is new is
held against the whole memory: is it more likely under that, or as the beginning of something else, of which nothing is
expected but that it stays as it began (Polya's urn)? Sums of the logarithms of this ratio that do not fall back to 0
tell a change and when it began (CUSUM, Page 1954). What was measured before it is then forgotten, of times as of
outcomes.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from protos.base.histogram import BUCKETS, GROWTH

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from protos.base.histogram import Histogram

_PER_BIN = round(math.log(2.0) / math.log(GROWTH))
"""Buckets of a histogram that count as one: times up to twice as long."""

_FIRST = np.arange(0, BUCKETS, _PER_BIN)
_BINS = len(_FIRST) + 1
"""With one for the lost."""

PRIOR_SAMPLES = 2.0
"""Of each kind that are taken for granted, evenly, beside what was measured: who was hardly measured hardly changes."""

NEW_PRIOR_SAMPLES = 1.0
"""The same for what may have begun: its second sample is as likely like the first as anything."""

MAX_EVIDENCE = 2.5
"""No single sample says more: a server that once took long may have done so by chance, three times in a row not."""

ENOUGH_EVIDENCE = 6.0
"""A logarithm: a change is some hundred times as likely."""

LEAST_S = 0.4
"""A change lasts at least as long; all that waited behind one hiccup of a server is a single event."""

NEIGHBOURS_SHARE = 0.15
"""Of what is expected of a bin, of the next faster and of the next slower one each: times spread."""

DRIFT = 0.3
"""Taken off for each sample, so that what goes on as usual does not look like something that begins."""

USUAL_SHARE = 0.2
"""Nothing new begins with a sample where so many of those before it took half to twice as long."""


class ChangeWatch:
    """Holds new samples against a memory of old ones; the memory is the caller's. Times are monotonic seconds."""

    __slots__ = ("_began", "_evidence", "_since", "accused")

    def __init__(self) -> None:
        self.accused = False
        """Whether the samples added last spoke for a change."""
        self._evidence = 0.0
        self._began = math.inf
        self._since: Histogram | None = None

    @property
    def suspects(self) -> bool:
        """Whether the last samples were odd, but too few yet to tell a change."""
        return self._since is not None

    def add(
        self, new: Histogram, known: NDArray[np.float64], known_lost: float, kept: float, now: float
    ) -> Histogram | None:
        """Judge new samples by what is known without them, of which a share of `kept` still counts.

        What came since the change if there was one, else None; it is `settled` then, or `doubted`.
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
        """The change is taken note of."""
        self._evidence, self._since = 0.0, None

    def doubted(self) -> None:
        """The change is not believed yet: more of the same says no more than this did."""
        self._evidence = ENOUGH_EVIDENCE


def _is_usual(new: Histogram, known: NDArray[np.float64], known_lost: float, kept: float) -> bool:
    if new.lost:
        return False
    sums = np.add.reduce
    least = USUAL_SHARE * (float(sums(known)) + known_lost + PRIOR_SAMPLES / kept)
    return all(sums(known[max(0, bucket - _PER_BIN) : bucket + _PER_BIN + 1]) >= least for bucket in new.sparse[0])


def _log_begun(counts: NDArray[np.float64], since: Histogram | None) -> float:
    """Logarithm of the probability of these samples, one by one, where others began."""
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
