"""Compares predicted with observed miss ratios: the estimator is fed in time order and queried every second."""

from __future__ import annotations

import math
import random
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import beta

from bench.matcher.feed import PAIRS, REPORT_INTERVAL_S, ROBOT, SERVICE, Reporter
from bench.matcher.races import ANSWER_BYTES
from plr.controlplane.core.estimate.estimator import Estimator
from plr.controlplane.core.estimate.posterior import Estimate

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from bench.matcher.races import Races

DEADLINES_S = (0.1, 0.15, 0.25, 0.5, 1.0)
HALF_LIFE_S = 60.0
"""The control plane's default."""
REPORTS_PER_PREDICTION = 2
"""Reports for each prediction: the matcher solves again every second."""
KINDS = ("a", "b", "product", "joint")
FEWEST_MISSES = 30.0
"""Expected misses of a cell below which its observed ratio is mostly chance."""
NEAR = 1.5
"""Ratio of observed to predicted, or the reverse, that passes if the interval does not hold."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One trace, workload, deadline and kind of prediction: misses in all, predicted and observed.

    `low` and `high` are the ends of the 90 % intervals stated with each prediction, summed over requests as `expected`
    is: what the observed misses lie between if the errors of successive predictions all point the same way.
    """

    trace: str
    workload: str
    deadline_s: float
    kind: str
    requests: int
    expected: float
    low: float
    high: float
    observed: int

    @property
    def log_error(self) -> float:
        """|log(observed / expected)|, with half a miss added to each."""
        return abs(math.log((self.observed + 0.5) / (self.expected + 0.5)))

    @property
    def inside(self) -> bool:
        """Whether the observed misses lie in the stated interval."""
        return self.low <= self.observed <= self.high

    @property
    def near(self) -> bool:
        """Whether expected and observed differ by a factor of at most `NEAR`."""
        return self.expected / NEAR <= self.observed <= self.expected * NEAR


def cells_of(races: Races, deadline_s: float, predicted: Arrays) -> Iterator[Cell]:
    """Yield the cells of one replay with one deadline."""
    counts, estimates, misses = predicted
    first, second = estimates[..., 0], estimates[..., 1]
    low, mean, high = beta.ppf(0.05, first, second), first / (first + second), beta.ppf(0.95, first, second)
    expected, lows, highs = (counts @ values for values in (mean, low, high))
    observed = misses.sum(axis=0)
    for column, (kind, which) in enumerate(zip(KINDS, (0, 1, 2, 2), strict=True)):
        yield Cell(
            races.trace,
            races.workload.name,
            deadline_s,
            kind,
            int(counts.sum()),
            float(expected[column]),
            float(lows[column]),
            float(highs[column]),
            int(observed[which]),
        )


Arrays = tuple["np.ndarray[tuple[int, ...], np.dtype[np.float64]]", ...]


def predict(races: Races, deadline_s: float) -> Arrays:
    """Return for each report's interval: requests; Beta parameters of each kind; misses on a, on b, on both."""
    rng = random.Random(zlib.crc32(races.trace.encode()))
    reporter = Reporter(deadline_s, rng, size=races.workload.size + ANSWER_BYTES)
    estimator = Estimator(half_life_s=HALF_LIFE_S)
    probes, waiting = iter(races.probes), iter(races.races)
    probe, race = next(probes, None), next(waiting, None)
    counts: list[int] = []
    rows: list[list[tuple[float, float]]] = []
    misses: list[list[int]] = []
    row: list[tuple[float, float]] = []
    for tick in range(math.ceil(races.duration_s / REPORT_INTERVAL_S)):
        now = tick * REPORT_INTERVAL_S
        estimator.merge(ROBOT, reporter.take(now), now)
        if tick % REPORTS_PER_PREDICTION == 0:
            row = [(estimate.misses, estimate.hits) for estimate in predictions(estimator, deadline_s, now)]
        missed = [0, 0, 0]
        count = 0
        while probe is not None and probe.at_s < now + REPORT_INTERVAL_S:
            reporter.probed(probe)
            probe = next(probes, None)
        while race is not None and race.at_s < now + REPORT_INTERVAL_S:
            reporter.raced(race)
            count += 1
            missed[0] += race.latency_s[0] > deadline_s
            missed[1] += race.latency_s[1] > deadline_s
            missed[2] += min(race.latency_s) > deadline_s
            race = next(waiting, None)
        counts.append(count)
        rows.append(row)
        misses.append(missed)
    return np.array(counts, dtype=float), np.array(rows), np.array(misses, dtype=float)


def predictions(estimator: Estimator, deadline_s: float, now: float) -> tuple[Estimate, ...]:
    """Return the estimates of each path, of both together if independent, and of both as measured."""
    one, other = (estimator.estimate(ROBOT, pair.interface, pair.server, SERVICE, deadline_s, now) for pair in PAIRS)
    product = _product(one, other)
    return one, other, product, estimator.both_miss(ROBOT, SERVICE, *PAIRS, product.mean, now)


def _product(one: Estimate, other: Estimate) -> Estimate:
    """Return the Beta distribution with mean and variance of the product of two independent ones."""
    mean = one.mean * other.mean
    variance = _second_moment(one) * _second_moment(other) - mean * mean
    return Estimate.of(mean, mean * (1.0 - mean) / variance - 1.0)


def _second_moment(estimate: Estimate) -> float:
    return estimate.mean * (estimate.misses + 1.0) / (estimate.weight + 1.0)


def share_calibrated(cells: Sequence[Cell]) -> float | None:
    """Return the share, among cells with enough expected misses, inside their interval or near; None without any."""
    judged = [cell for cell in cells if cell.expected >= FEWEST_MISSES]
    return sum(cell.inside or cell.near for cell in judged) / len(judged) if judged else None


def paired(cells: Sequence[Cell]) -> list[tuple[Cell, Cell]]:
    """Return product and joint cells of the same requests, where either expects, or both observe, enough misses."""
    joint = {(cell.trace, cell.workload, cell.deadline_s): cell for cell in cells if cell.kind == "joint"}
    pairs = [(cell, joint[cell.trace, cell.workload, cell.deadline_s]) for cell in cells if cell.kind == "product"]
    return [(one, other) for one, other in pairs if max(one.expected, other.expected, one.observed) >= FEWEST_MISSES]
