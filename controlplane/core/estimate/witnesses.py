"""Weighs what robots report of a server's processing times: no robot outweighs all the others.

What a server needs is known from all robots' reports, and one of them may be hacked, or merely odd. So a robot counts
for as much as the busiest other one, and for a few hundred requests in any case; alone, for a thousand. That a server
has changed, after which what was known of it is forgotten, takes the word of two robots if more than one reports.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from typing import TYPE_CHECKING

import numpy as np

from plr.controlplane.core.estimate.fading import FadedCount
from plr.protos.base.histogram import Histogram

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName

MAX_WITNESSES = 64
"""Robots remembered for each server and service; the one that reported least recently is evicted."""

COUNTS_ANYWAY = 300.0
"""A robot counts for this many requests however little the others call: misses of one in a hundred are known."""

MOST_ALONE = 1000.0
"""A robot counts for this many if no other one has reported recently: robots that come later need not wait for long."""

RANKS_ALIKE = 1e-6
"""Ranks closer than this may differ by rounding alone."""

LATELY_S = 5.0
"""A robot that reported within this time is a witness now: robots report once a second or so."""


class Witnesses:
    """The robots that reported on one server and service. Times are monotonic seconds."""

    __slots__ = ("_accusers", "_counts", "_half_life_s", "_heard_at", "_ranks")

    def __init__(self, half_life_s: float) -> None:
        self._half_life_s = half_life_s
        self._counts: OrderedDict[NodeName, FadedCount] = OrderedDict()
        self._ranks: dict[NodeName, float] = {}
        """Ranks by which they count for more or less at any time: see `FadedCount.rank`."""
        self._heard_at: dict[NodeName, float] = {}
        self._accusers: set[NodeName] = set()
        """Robots whose recent samples spoke for a change."""

    def weigh(self, robot: NodeName, processing: Histogram, now: float) -> Histogram:
        """Return as many of a robot's samples as it counts for, evenly thinned out, and note them."""
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
        """Return how much the busiest other robot counts for by now."""
        self._ranks[robot] = -math.inf
        least = max(self._ranks.values()) - RANKS_ALIKE
        return max(
            (self._counts[name].weight(now) for name, rank in self._ranks.items() if rank >= least and name != robot),
            default=0.0,
        )

    def accuses(self, robot: NodeName) -> None:
        """Note that the robot's samples spoke for a change."""
        self._accusers.add(robot)

    def acquit(self) -> None:
        """Clear the accusers: there was no change, or it has been taken into account."""
        self._accusers.clear()

    def agree(self, now: float) -> bool:
        """Return whether enough robots spoke for a change to believe it."""
        lately = {name for name, at in self._heard_at.items() if now - at <= LATELY_S}
        return len(self._accusers) > 1 or lately <= self._accusers

    def largest_share(self, now: float) -> tuple[NodeName, float] | None:
        """Return who counts for most, and for what share of all; None without any."""
        weights = {name: count.weight(now) for name, count in self._counts.items()}
        total = sum(weights.values())
        if total <= 0.0:
            return None
        name = max(weights, key=lambda one: weights[one])
        return name, weights[name] / total

    def __len__(self) -> int:
        return len(self._counts)


def thinned(histogram: Histogram, kept: int) -> Histogram:
    """Return `kept` samples of a histogram, from each bucket its share, rounded to the largest remainders."""
    if kept <= 0:
        return Histogram()
    counts = np.append(histogram.counts, histogram.lost).astype(np.float64)
    exact = counts * (kept / counts.sum())
    whole = np.floor(exact)
    missing = kept - int(whole.sum())
    whole[np.argsort(whole - exact, kind="stable")[:missing]] += 1.0
    used = np.flatnonzero(whole[:-1])
    return Histogram.from_sparse(used.tolist(), whole[used].astype(np.int64).tolist(), int(whole[-1]))
