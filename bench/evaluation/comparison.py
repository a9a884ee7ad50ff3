"""Contenders beside each other in the same windows: over the better direct path, and from what the networks allow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from bench.dataplane.statistics import difference, median, ratio
from bench.evaluation.ideal import IDEALS
from bench.evaluation.outcome import Outcome, figures_by_window

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from bench.evaluation.outcome import Figures

DIRECT = ("direct-a", "direct-b")
IDEAL = "ideal"


@dataclass(frozen=True, slots=True)
class Comparison:
    """One contender in one window. None: what it is compared with was not run, or is void."""

    mean_gain: float | None
    """How many times lower its mean is than the lower mean of the two direct runs."""
    p99_gain: float | None
    """Likewise, of the 99th percentile."""
    miss_over_ideal: float | None
    """Its miss ratio minus the ideal's."""
    p99_over_ideal: float | None
    """Its 99th percentile over the ideal's."""


@dataclass(frozen=True, slots=True)
class Gains:
    """One contender's medians over windows."""

    windows: int
    mean_gain: float | None
    p99_gain: float | None


def better_direct(runs: Mapping[str, Outcome]) -> Outcome:
    """Of the two direct runs of one window, the one that missed less; of two alike the one with the lower mean."""
    return min((runs[name] for name in DIRECT), key=lambda run: (run.figures().miss_ratio, run.figures().mean_ms))


def compare(outcomes: Iterable[Outcome]) -> dict[str, dict[str, Comparison]]:
    """Scenario -> contender -> comparison, of runs that are not void."""
    return {
        scenario: {name: _one(of, by_name) for name, of in by_name.items() if name not in IDEALS}
        for scenario, by_name in figures_by_window(outcomes).items()
    }


def gains(outcomes: Iterable[Outcome]) -> dict[str, Gains]:
    """Contender -> medians over the windows in which at least one of the two direct runs missed a deadline."""
    kept = list(outcomes)
    hard = {
        name
        for name, by_name in figures_by_window(kept).items()
        if all(direct in by_name for direct in DIRECT) and any(by_name[direct].miss_ratio > 0 for direct in DIRECT)
    }
    found: dict[str, list[Comparison]] = {}
    for scenario, by_name in compare(kept).items():
        for contender, comparison in by_name.items():
            if scenario in hard and contender not in DIRECT:
                found.setdefault(contender, []).append(comparison)
    return {
        contender: Gains(len(all_of), median(one.mean_gain for one in all_of), median(one.p99_gain for one in all_of))
        for contender, all_of in found.items()
    }


def _one(of: Figures, beside: Mapping[str, Figures]) -> Comparison:
    direct = [beside[name] for name in DIRECT if name in beside]
    both = len(direct) == len(DIRECT)
    ideal = beside.get(IDEAL)
    return Comparison(
        mean_gain=ratio(min(one.mean_ms for one in direct), of.mean_ms) if both else None,
        p99_gain=ratio(min(one.p99_ms for one in direct), of.p99_ms) if both else None,
        miss_over_ideal=difference(of.miss_ratio, ideal.miss_ratio) if ideal else None,
        p99_over_ideal=ratio(of.p99_ms, ideal.p99_ms) if ideal else None,
    )
