"""What is believed of a probability: Beta distributions, and trials whose outcomes come in streaks."""

from __future__ import annotations

import math
from dataclasses import dataclass

BATCH_S = 5.0
"""Outcomes are summed up over this long before their spread is looked at: a handover is within, an outage spans a
few."""

USUAL_STREAK = 5.0
"""By how much streaks usually inflate the variance of a miss ratio: the median over recorded drives is 3 to 8."""

USUAL_STREAK_BATCHES = 4.0
"""How many batches that experience weighs."""

MAX_BATCH_CORRELATION = 0.9
"""Nothing that fades within a minute can tell a longer memory from a change."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A probability, known as Beta(misses, hits): both above 0, and larger the more is known."""

    misses: float
    hits: float

    @property
    def mean(self) -> float:
        """The probability that is expected."""
        return self.misses / (self.misses + self.hits)

    @property
    def weight(self) -> float:
        """How many independent trials the knowledge is worth."""
        return self.misses + self.hits

    @classmethod
    def of(cls, mean: float, weight: float) -> Estimate:
        """An estimate of that mean and weight; 0 < mean < 1."""
        return cls(mean * weight, (1.0 - mean) * weight)


class FadedTrials:
    """Trials and those among them that missed, fading with a half-life in seconds, and how they streak.

    Misses come in streaks, so n trials say less than n independent ones. The variance of sums over batches of
    `BATCH_S` beside that of independent trials, times (1 + r) / (1 - r) for the correlation r of neighbouring batches,
    is the design effect; n divided by it is what the trials are worth.
    """

    __slots__ = (
        "_at",
        "_batch_misses",
        "_batch_since",
        "_batch_trials",
        "_batches",
        "_half_life_s",
        "_independent",
        "_last",
        "_misses",
        "_neighbours",
        "_spread",
        "_trials",
    )

    def __init__(self, half_life_s: float, now: float) -> None:
        self._half_life_s = half_life_s
        self._at = now
        self._trials = self._misses = 0.0
        self._batch_since = now
        self._batch_trials = self._batch_misses = 0.0
        self._batches = self._spread = self._neighbours = self._independent = self._last = 0.0

    def add(self, trials: float, misses: float, now: float) -> None:
        """Count trials, `misses` of them missed."""
        self._fade(now)
        self._trials += trials
        self._misses += misses
        self._batch_trials += trials
        self._batch_misses += misses
        if now - self._batch_since >= BATCH_S:
            self._close_batch(now)

    def _fade(self, now: float) -> None:
        factor = math.exp2((self._at - now) / self._half_life_s)
        self._at = now
        self._trials *= factor
        self._misses *= factor
        self._batches *= factor
        self._spread *= factor
        self._neighbours *= factor
        self._independent *= factor

    def _close_batch(self, now: float) -> None:
        ratio = (self._misses + 0.5) / (self._trials + 1.0)
        residual = self._batch_misses - ratio * self._batch_trials
        self._batches += 1.0
        self._spread += residual * residual
        self._neighbours += residual * self._last
        self._independent += self._batch_trials * ratio * (1.0 - ratio)
        self._last = residual
        self._batch_since = now
        self._batch_trials = self._batch_misses = 0.0

    def counts(self, now: float) -> tuple[float, float]:
        """(trials, misses) as they weigh by now."""
        factor = math.exp2((self._at - now) / self._half_life_s)
        return self._trials * factor, self._misses * factor

    def design_effect(self) -> float:
        """By how much streaks inflate the variance of the ratio, at least 1."""
        usual = USUAL_STREAK * USUAL_STREAK_BATCHES
        if self._batches < 1.0 or self._independent <= 0.0:
            return USUAL_STREAK
        each = self._independent / self._batches
        dispersion = (self._spread / each + usual) / (self._batches + USUAL_STREAK_BATCHES)
        correlation = self._neighbours / self._spread if self._spread else 0.0
        correlation *= self._batches / (self._batches + USUAL_STREAK_BATCHES)
        correlation = min(max(correlation, 0.0), MAX_BATCH_CORRELATION)
        return max(1.0, dispersion * (1.0 + correlation) / (1.0 - correlation))

    def posterior(self, prior: Estimate, now: float) -> Estimate:
        """The prior, and what the trials are worth: their mean counts every trial, the weight only what they say."""
        trials, misses = self.counts(now)
        mean = (misses + prior.misses) / (trials + prior.weight)
        return Estimate.of(mean, trials / self.design_effect() + prior.weight)
