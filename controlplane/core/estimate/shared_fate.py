"""Judges whether requests that miss over one of a robot's interfaces miss over another one as well.

The question is what two interfaces have in common, such as a carrier, not what a path does this minute. So this
remembers for long, whichever servers a mapping names meanwhile, and compares with the chance in the same requests.
Reasons: docs/develop/theory.md, "Interfaces that fail together".
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from plr.controlplane.core.estimate.beta import quantiles
from plr.controlplane.core.estimate.posterior import BATCH_S, MAX_BATCH_CORRELATION, USUAL_STREAK, USUAL_STREAK_BATCHES
from plr.protos.model.explanation import Correlation

if TYPE_CHECKING:
    from plr.protos.model.report import InterfaceJointReport

HALF_LIFE_S = 600.0
"""Carriers do not change, places do: trouble a few minutes apart counts together, that of another district does not."""

MIN_BOTH_MISSED = 2.0
"""Number of common misses below which nothing is said."""

MIN_LIFT = 1.5
"""How many times as often as by chance both must have missed; a value nearer to 1 is not worth reporting."""

SURE, LIKELY = 0.01, 0.05
"""Limits on the chance of that many common misses, for interfaces that fail together and that seem to."""

ALONE_PRIOR, RACE_PRIOR = 0.5, 1.0
"""Jeffreys' prior for missing on one interface alone, in races."""


@dataclass(frozen=True, slots=True)
class CommonMisses:
    """What is known by now of requests sent over two interfaces; old ones count less."""

    requests: float
    first_missed: float
    """Misses among these requests, above 0; estimated from all that missed on both and races that missed on one."""
    second_missed: float
    both_missed: float
    correlation: Correlation


class _Batches:
    """Sums over batches of `BATCH_S` with n requests of which b missed on both, and over neighbouring batches."""

    __slots__ = ("_b", "_bb", "_bn", "_count", "_last_b", "_last_n", "_n", "_next_bb", "_next_bn", "_next_nn", "_nn")

    def __init__(self) -> None:
        self._count = self._n = self._b = self._nn = self._bn = self._bb = 0.0
        self._next_nn = self._next_bn = self._next_bb = 0.0
        self._last_n = self._last_b = 0.0

    def fade(self, kept: float) -> None:
        self._count *= kept
        self._n *= kept
        self._b *= kept
        self._nn *= kept
        self._bn *= kept
        self._bb *= kept
        self._next_nn *= kept
        self._next_bn *= kept
        self._next_bb *= kept

    def add(self, n: float, b: float) -> None:
        self._count += 1.0
        self._n += n
        self._b += b
        self._nn += n * n
        self._bn += b * n
        self._bb += b * b
        self._next_nn += n * self._last_n
        self._next_bn += b * self._last_n + n * self._last_b
        self._next_bb += b * self._last_b
        self._last_n, self._last_b = n, b

    def design_effect(self) -> float:
        """Return by how much streaks inflate the variance of the number of common misses, at least 1."""
        ratio = self._b / self._n if self._n else 0.0
        independent = ratio * (1.0 - ratio) * self._n
        if self._count < 1.0 or independent <= 0.0:
            return USUAL_STREAK
        spread = max(0.0, self._bb - 2.0 * ratio * self._bn + ratio * ratio * self._nn)
        neighbours = self._next_bb - ratio * self._next_bn + ratio * ratio * self._next_nn
        experience = self._count + USUAL_STREAK_BATCHES
        dispersion = (spread * self._count / independent + USUAL_STREAK * USUAL_STREAK_BATCHES) / experience
        correlation = neighbours / spread * self._count / experience if spread else 0.0
        correlation = min(max(correlation, 0.0), MAX_BATCH_CORRELATION)
        return max(1.0, dispersion * (1.0 + correlation) / (1.0 - correlation))


class SharedFate:
    """Requests of one service that went over two interfaces at once. Times are monotonic seconds."""

    __slots__ = ("_at", "_batch_missed", "_batch_requests", "_batch_since", "_batches", "_counts")

    def __init__(self, now: float) -> None:
        self._at = now
        self._counts = (0.0, 0.0, 0.0, 0.0, 0.0)
        self._batches = _Batches()
        self._batch_since = now
        self._batch_requests = self._batch_missed = 0.0

    @property
    def at(self) -> float:
        """When something was last added."""
        return self._at

    def add(self, report: InterfaceJointReport, now: float) -> None:
        """Count what a report says."""
        kept = math.exp2((self._at - now) / HALF_LIFE_S)
        self._at = now
        news = (
            report.requests,
            report.both_missed,
            report.races,
            report.only_first_missed,
            report.only_second_missed,
        )
        requests, both, races, first, second = (old * kept + new for old, new in zip(self._counts, news, strict=True))
        self._counts = requests, both, races, first, second
        self._batches.fade(kept)
        self._batch_requests += report.requests
        self._batch_missed += report.both_missed
        if now - self._batch_since >= BATCH_S:
            self._batches.add(self._batch_requests, self._batch_missed)
            self._batch_since = now
            self._batch_requests = self._batch_missed = 0.0

    def common_misses(self, now: float) -> CommonMisses | None:
        """Return what is known; None without requests."""
        kept = math.exp2((self._at - now) / HALF_LIFE_S)
        requests, both, races, only_first, only_second = (count * kept for count in self._counts)
        if requests < RACE_PRIOR:
            return None
        ratio = both / requests
        first, second = (
            min(1.0, ratio + (alone + ALONE_PRIOR) / (races + RACE_PRIOR)) for alone in (only_first, only_second)
        )
        return CommonMisses(
            requests, first * requests, second * requests, both, self._correlation(requests, both, first, second)
        )

    def _correlation(self, requests: float, both_missed: float, first: float, second: float) -> Correlation:
        lift = both_missed / (requests * first * second)
        if both_missed < MIN_BOTH_MISSED or lift < MIN_LIFT:
            return Correlation.INDEPENDENT
        streaks = self._batches.design_effect()
        rarer, other = sorted((first, second))
        events, common = requests * rarer / streaks, both_missed / streaks
        a, b = np.array([common]), np.array([events - common + 1.0])
        # Clopper-Pearson limit: above it, this many have less than this probability to be common by chance.
        if quantiles(a, b, SURE)[0] > other:
            return Correlation.TOGETHER
        return Correlation.LIKELY if quantiles(a, b, LIKELY)[0] > other else Correlation.INDEPENDENT
