"""Measures statistics of a two-path trace, and derives those that follow from the generator's parameters.

For the uplink these are rates at some probabilities, autocorrelation and outages. For both paths together they are
Spearman's rank correlation, and how much more often than by chance both are too slow at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import multivariate_normal, norm, rankdata

from bench.evaluation.kinds import DEAD_ZONE_FACTOR

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bench.evaluation.carriers import Carrier, Floats
    from bench.evaluation.kinds import Kind
    from lab import Trace

SHOWN = (0.05, 0.25, 0.5, 0.75, 0.95)
LAGS_S = (1.0, 5.0, 20.0)
LOW_KBPS = 5_000.0
"""Approximate rate that 120 kB five times a second need."""


@dataclass(frozen=True, slots=True)
class PathStatistics:
    """Statistics of one path; NaN if unknown."""

    rates_kbps: tuple[float, ...]
    """Rates at the probabilities SHOWN."""
    autocorrelation: tuple[float, ...]
    """Autocorrelation of the rate's normal scores, at LAGS_S."""
    low_share: float
    """Share of time below LOW_KBPS."""
    outage_share: float
    outage_s: float
    """Mean length of a period of rate 0."""


@dataclass(frozen=True, slots=True)
class PairStatistics:
    """Statistics of both paths."""

    a: PathStatistics
    b: PathStatistics
    spearman: float
    """Rank correlation of the two rates."""
    low_lift: float
    """Share of time with both below LOW_KBPS, over the product of the single shares."""


def measure(traces: Sequence[Trace]) -> PairStatistics:
    """Return the joint statistics of traces of one family; the correlation is the median over the traces."""
    pairs = [(_rates(trace, "a"), _rates(trace, "b")) for trace in traces]
    step_s = traces[0].paths["a"][1].at_s
    low = np.concatenate([np.stack([a < LOW_KBPS, b < LOW_KBPS]) for a, b in pairs], axis=1)
    single_a, single_b = low.mean(axis=1)
    chance = single_a * single_b
    return PairStatistics(
        _path([a for a, _ in pairs], step_s),
        _path([b for _, b in pairs], step_s),
        float(np.median([np.corrcoef(rankdata(a), rankdata(b))[0, 1] for a, b in pairs])),
        float(low.all(axis=0).mean() / chance) if chance else math.nan,
    )


def stated(kind: Kind) -> PairStatistics:
    """Return the statistics that follow from a kind's parameters, without its blackouts.

    The rank correlation is that of the scores alone, which outages and dead zones change a little.
    """
    correlation = _score_correlation(kind)
    dead = kind.dead_share
    low = [_low(carrier, LOW_KBPS) for carrier in (kind.a, kind.b)]
    high_scores = multivariate_normal(mean=[0, 0], cov=[[1, correlation], [correlation, 1]])
    # Share with both above: by symmetry, with both scores below the negative of where they stop being low.
    limits = [-norm.ppf(carrier.probability_below(LOW_KBPS)) for carrier in (kind.a, kind.b)]
    both_high = (1 - kind.a.outage_share) * (1 - kind.b.outage_share) * float(high_scores.cdf(limits))
    both_low = dead + (1 - dead) * (low[0] + low[1] - 1 + both_high)
    shares = [dead + (1 - dead) * share for share in low]
    return PairStatistics(
        _stated_path(kind.a, dead, shares[0]),
        _stated_path(kind.b, dead, shares[1]),
        6 / math.pi * math.asin(correlation / 2),
        both_low / (shares[0] * shares[1]) if shares[0] * shares[1] else math.nan,
    )


def _rates(trace: Trace, path: str) -> Floats:
    return np.array([step.up.rate_kbps or 0.0 for step in trace.path(path)])


def _path(rates: Sequence[Floats], step_s: float) -> PathStatistics:
    together = np.concatenate(rates)
    ends = np.cumsum([len(one) for one in rates])[:-1]
    scores = np.split(norm.ppf((rankdata(together) - 0.5) / len(together)), ends)
    outages = [len(list(run)) for one in rates for dark, run in groupby((one == 0.0).tolist()) if dark]
    return PathStatistics(
        tuple(np.quantile(together, SHOWN).tolist()),
        tuple(_autocorrelation(scores, round(lag_s / step_s)) for lag_s in LAGS_S),
        float((together < LOW_KBPS).mean()),
        float((together == 0.0).mean()),
        sum(outages) / len(outages) * step_s if outages else math.nan,
    )


def _autocorrelation(scores: Sequence[Floats], lag: int) -> float:
    products = np.concatenate([one[lag:] * one[:-lag] for one in scores])
    return float(products.mean() / np.concatenate(scores).var()) if len(products) else math.nan


def _score_correlation(kind: Kind) -> float:
    """Return the correlation of two sums of autoregressive processes with correlated innovations."""
    a, b = kind.a, kind.b

    def kept(a_s: float, b_s: float) -> float:
        one, other = (math.exp(-kind.step_s / memory) for memory in (a_s, b_s))
        return math.sqrt((1 - one**2) * (1 - other**2)) / (1 - one * other)

    slow = math.sqrt(a.slow_share * b.slow_share) * kept(a.slow_s, b.slow_s)
    fast = math.sqrt((1 - a.slow_share) * (1 - b.slow_share)) * kept(a.fast_s, b.fast_s)
    return kind.common * (slow + fast)


def _low(carrier: Carrier, rate_kbps: float) -> float:
    """Return the share of time below a rate, without dead zones."""
    return carrier.outage_share + (1 - carrier.outage_share) * carrier.probability_below(rate_kbps)


def _stated_path(carrier: Carrier, dead: float, low_share: float) -> PathStatistics:
    grid = np.geomspace(1.0, carrier.rates_kbps[-1], 4000)
    below = [(1 - dead) * _low(carrier, rate) + dead * _low(carrier, rate / DEAD_ZONE_FACTOR) for rate in grid.tolist()]
    return PathStatistics(
        tuple(np.interp(SHOWN, below, grid).tolist()),
        tuple(carrier.autocorrelation(lag_s) for lag_s in LAGS_S),
        low_share,
        carrier.outage_share,
        carrier.outage_s if carrier.outage_share else math.nan,
    )
