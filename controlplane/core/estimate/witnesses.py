"""Who bore witness to what a server needs, and for how much it counts: no robot outweighs all the others.

What a server needs is known from all robots' reports, and one of them may be hacked, or merely odd. So a robot counts
for as much as the busiest other one, and for a few hundred requests in any case; alone, for a thousand.
And that a server has changed, after which what was known of it is forgotten, takes the word of two where more than one
bears witness.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from typing import TYPE_CHECKING

import numpy as np

from controlplane.core.estimate.fading import FadedCount
from protos.base.histogram import Histogram

if TYPE_CHECKING:
    from protos.model.ids import NodeName

MAX_WITNESSES = 64
"""Robots remembered for each server and service, the one that reported least recently goes."""

COUNTS_ANYWAY = 300.0
"""For so many requests a robot counts however little the others call: misses of one in a hundred are known."""

MOST_ALONE = 1000.0
"""For so many a robot counts where no other one has reported lately: those who come later need not wait for long."""

RANKS_ALIKE = 1e-6
"""Ranks closer than this may differ by rounding alone."""

LATELY_S = 5.0
"""Who reported within this time bears witness now: robots report once a second or so."""


class Witnesses:
    """The robots that reported on one server and service. Times are monotonic seconds."""

    __slots__ = ("_accusers", "_counts", "_half_life_s", "_heard_at", "_ranks")

    def __init__(self, half_life_s: float) -> None:
        self._half_life_s = half_life_s
        self._counts: OrderedDict[NodeName, FadedCount] = OrderedDict()
        self._ranks: dict[NodeName, float] = {}
        """By which they count for more or less, whatever the time: see `FadedCount.rank`."""
        self._heard_at: dict[NodeName, float] = {}
        self._accusers: set[NodeName] = set()
        """Whose samples lately spoke for a change."""

    def weigh(self, robot: NodeName, processing: Histogram, now: float) -> Histogram:
        """Return of a robot's samples as many as it counts for, evenly thinned out, and note them."""
        count = self._counts.get(robot)
        if count is None:
            count = FadedCount(self._half_life_s, now)
        self._counts[robot] = count
        self._counts.move_to_end(robot)
        self._heard_at[robot] = now
        if len(self._counts) > MAX_WITNESSES:
            gone, _ = self._counts.popitem(last=False)
            del self._heard_at[gone], self._ranks[gone]
            self._accusers.discard(gone)
        busiest = self._busiest_but(robot, now)
        most = max(busiest, COUNTS_ANYWAY) if busiest >= 1.0 else MOST_ALONE
        samples = processing.total
        kept = min(samples, max(0, int(most - count.weight(now))))
        count.add(kept, 0.0, now)
        self._ranks[robot] = count.rank()
        return processing if kept == samples else thinned(processing, kept)

    def _busiest_but(self, robot: NodeName, now: float) -> float:
        """For how much the busiest other one counts by now."""
        self._ranks[robot] = -math.inf
        least = max(self._ranks.values()) - RANKS_ALIKE
        return max(
            (self._counts[name].weight(now) for name, rank in self._ranks.items() if rank >= least and name != robot),
            default=0.0,
        )

    def accuses(self, robot: NodeName) -> None:
        """Its samples spoke for a change."""
        self._accusers.add(robot)

    def acquit(self) -> None:
        """There was no change, or it is taken note of."""
        self._accusers.clear()

    def agree(self, now: float) -> bool:
        """Whether those who spoke for a change are enough to believe it."""
        lately = {name for name, at in self._heard_at.items() if now - at <= LATELY_S}
        return len(self._accusers) > 1 or lately <= self._accusers

    def largest_share(self, now: float) -> tuple[NodeName, float] | None:
        """Who counts for most, and for what share of all; None without any."""
        weights = {name: count.weight(now) for name, count in self._counts.items()}
        total = sum(weights.values())
        if total <= 0.0:
            return None
        name = max(weights, key=lambda one: weights[one])
        return name, weights[name] / total

    def __len__(self) -> int:
        return len(self._counts)


def thinned(histogram: Histogram, kept: int) -> Histogram:
    """Return `kept` samples of a histogram, of each bucket as many as its share, rounded to the largest remainders."""
    if kept <= 0:
        return Histogram()
    counts = np.append(histogram.counts, histogram.lost).astype(np.float64)
    exact = counts * (kept / counts.sum())
    whole = np.floor(exact)
    missing = kept - int(whole.sum())
    whole[np.argsort(whole - exact, kind="stable")[:missing]] += 1.0
    used = np.flatnonzero(whole[:-1])
    return Histogram.from_sparse(used.tolist(), whole[used].astype(np.int64).tolist(), int(whole[-1]))
