"""Represents what is believed of a probability: Beta distributions, and trials whose outcomes come in streaks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from plr.controlplane.core.estimate.staleness import Silence

if TYPE_CHECKING:
    from plr.controlplane.core.estimate.staleness import HeardClock

MEMORIES = ((1.0, 1.0), (1 / 4, 0.3), (1 / 15, 0.3))
"""Half-lives of the parallel memories, as parts of the configured one, and the prior probability that each is the best:
a long memory knows a steady path best, a short one a path that enters a tunnel."""

SCORE_HALF_LIFE = 1 / 3
"""Half-life, as a part of the configured one, of the record of how well each memory predicted."""

HANDED_ON = 2.0
"""Worth in trials of a memory's ratio to the next shorter one, which starts from it."""

BATCH_S = 5.0
"""Outcomes are summed over this long before their spread is examined: a handover is within, an outage spans a few."""

USUAL_STREAK = 5.0
"""By how much streaks usually inflate the variance of a miss ratio."""

USUAL_STREAK_BATCHES = 4.0
"""How many batches that experience is worth."""

MAX_BATCH_CORRELATION = 0.9
"""Limit, as nothing that fades within a minute can tell a longer memory from a change."""

_SURE = 1e-6
"""No ratio is taken to be nearer to 0 or 1 when predictions are scored."""
LEAST_MEAN = 1e-12
"""Least distance of a mean from 0 and 1: a distribution needs some weight on either side."""
MOST_TRIALS = 1e6
"""Requests that one report may count. A member may claim any number, and beyond 2^53 sums are no longer exact: a
posterior without any hit left has no distribution, and planning would fail for the whole fleet."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A probability, known as Beta(misses, hits): both are above 0 and grow with what is known."""

    misses: float
    hits: float

    @property
    def mean(self) -> float:
        """Expected probability."""
        return self.misses / (self.misses + self.hits)

    @property
    def weight(self) -> float:
        """How many independent trials the knowledge is worth."""
        return self.misses + self.hits

    @classmethod
    def of(cls, mean: float, weight: float) -> Estimate:
        """Return an estimate of that mean and weight; a mean that rounding made 0 or 1 is kept off them."""
        mean = min(max(mean, LEAST_MEAN), 1.0 - LEAST_MEAN)
        return cls(mean * weight, (1.0 - mean) * weight)


IGNORANCE = Estimate(0.5, 0.5)
"""Jeffreys' prior: without any knowledge, one in two misses."""


class _Memory:
    """Trials and misses that fade with one half-life, and the log-likelihood of what it predicted."""

    __slots__ = ("half_life_s", "misses", "score", "share", "trials")

    def __init__(self, half_life_s: float, share: float) -> None:
        self.half_life_s = half_life_s
        self.share = share
        self.trials = self.misses = self.score = 0.0


class _Streaks:
    """How much more batches of misses spread around the prediction than independent misses would."""

    __slots__ = (
        "_batches",
        "_expected",
        "_independent",
        "_last",
        "_misses",
        "_neighbours",
        "_since",
        "_spread",
        "_variance",
    )

    def __init__(self, now: float) -> None:
        self._since = now
        self._misses = self._expected = self._variance = 0.0
        self._batches = self._spread = self._neighbours = self._independent = self._last = 0.0

    def fade(self, factor: float) -> None:
        self._batches *= factor
        self._spread *= factor
        self._neighbours *= factor
        self._independent *= factor

    def add(self, trials: float, misses: float, predicted: float, now: float) -> None:
        self._misses += misses
        self._expected += trials * predicted
        self._variance += trials * predicted * (1.0 - predicted)
        if now - self._since >= BATCH_S:
            residual = self._misses - self._expected
            self._batches += 1.0
            self._spread += residual * residual
            self._neighbours += residual * self._last
            self._independent += self._variance
            self._last = residual
            self._since = now
            self._misses = self._expected = self._variance = 0.0

    def design_effect(self) -> float:
        if self._batches < 1.0 or self._independent <= 0.0:
            return USUAL_STREAK
        each = self._independent / self._batches
        experience = self._batches + USUAL_STREAK_BATCHES
        dispersion = (self._spread / each + USUAL_STREAK * USUAL_STREAK_BATCHES) / experience
        correlation = self._neighbours / self._spread if self._spread else 0.0
        correlation = min(max(correlation * self._batches / experience, 0.0), MAX_BATCH_CORRELATION)
        return max(1.0, dispersion * (1.0 + correlation) / (1.0 - correlation))


class FadedTrials:
    """Trials and those of them that missed, fading, with what they predict for the next one.

    Several memories of different lengths run in parallel. Each shorter one starts from the ratio of the longer one
    before it. All are averaged by how well they predicted recently: their weights are proportional to the likelihood of
    what came, as in Bayesian model averaging with forgetting. Misses come in streaks, so n trials say less than n
    independent ones. The design effect is the variance of the prediction's errors over batches of `BATCH_S` relative to
    that of independent trials, times (1 + r) / (1 - r) for the correlation r of neighbouring batches; the trials are
    worth n divided by it. With the clock of their group they fade faster while only others of the group are reported.
    """

    __slots__ = ("_at", "_half_life_s", "_memories", "_silence", "_streaks")

    def __init__(self, half_life_s: float, now: float, clock: HeardClock | None = None) -> None:
        self._silence = Silence(clock)
        self._half_life_s = half_life_s
        self._at = now
        self._memories = tuple(_Memory(half_life_s * part, share) for part, share in MEMORIES)
        self._streaks = _Streaks(now)

    @property
    def at(self) -> float:
        """When something was last added."""
        return self._at

    def add(self, trials: float, misses: float, now: float) -> None:
        """Count trials, of which `misses` missed; more than MOST_TRIALS at once count as so many, missing as often."""
        if trials > MOST_TRIALS:
            trials, misses = MOST_TRIALS, misses * MOST_TRIALS / trials
        passed_s = now - self._at
        self._at = now
        self.forget(self._silence.end())
        predicted, _, ratios = self._predict(IGNORANCE, 0.0)
        score_fade = math.exp2(-passed_s / (self._half_life_s * SCORE_HALF_LIFE))
        hits = trials - misses
        for memory, ratio in zip(self._memories, ratios, strict=True):
            sure = ratio if _SURE < ratio < 1.0 - _SURE else min(max(ratio, _SURE), 1.0 - _SURE)
            surprise = misses * math.log(sure) + hits * math.log1p(-sure)
            memory.score = memory.score * score_fade + surprise
            fade = math.exp2(-passed_s / memory.half_life_s)
            memory.trials = memory.trials * fade + trials
            memory.misses = memory.misses * fade + misses
        self._streaks.fade(math.exp2(-passed_s / self._half_life_s))
        self._streaks.add(trials, misses, predicted, now)

    def forget(self, kept: float) -> None:
        """Reduce everything counted to this share."""
        if kept < 1.0:
            for memory in self._memories:
                memory.trials *= kept
                memory.misses *= kept
                memory.score *= kept

    def _predict(self, prior: Estimate, passed_s: float) -> tuple[float, float, list[float]]:
        """Return (ratio, trials) this much later, over all memories by how well each predicted; and their ratios.

        Each memory starts from the one before it, the longest from the prior.
        """
        kept = self._silence.kept()
        best = max([memory.score for memory in self._memories])
        misses, weight = prior.misses, prior.weight
        ratios: list[float] = []
        shares = mean = mean_trials = 0.0
        for memory in self._memories:
            fade = math.exp2(-passed_s / memory.half_life_s)
            ratio = (memory.misses * (fade * kept) + misses) / (memory.trials * (fade * kept) + weight)
            ratios.append(ratio)
            misses, weight = ratio * HANDED_ON, ratio * HANDED_ON + (1.0 - ratio) * HANDED_ON
            share = memory.share * math.exp(memory.score - best)
            shares += share
            mean += share * ratio
            mean_trials += share * (memory.trials * fade * kept)
        return mean / shares, mean_trials / shares, ratios

    def counts(self, now: float) -> tuple[float, float]:
        """Return the trials and misses that the longest memory still holds."""
        fade = math.exp2((self._at - now) / self._half_life_s) * self._silence.kept()
        return self._memories[0].trials * fade, self._memories[0].misses * fade

    def design_effect(self) -> float:
        """Return by how much streaks inflate the variance of the ratio, at least 1."""
        return self._streaks.design_effect()

    def posterior(self, prior: Estimate, now: float) -> Estimate:
        """Return the prior updated by the trials: the mean counts every trial, the weight only what they are worth."""
        passed_s = now - self._at
        mean, trials, _ = self._predict(prior, passed_s)
        return Estimate.of(mean, trials / self.design_effect() + prior.weight)
