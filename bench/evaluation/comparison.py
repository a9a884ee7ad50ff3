"""Contenders beside each other in the same windows: over the better direct path, and from what the networks allow."""

from __future__ import annotations

from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING

from bench.dataplane.statistics import difference, median, ratio
from bench.evaluation.ideal import IDEALS
from bench.evaluation.outcome import figures_by_window

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from bench.evaluation.outcome import Figures, Outcome, Windows

DIRECT = ("direct-a", "direct-b")
SUREST = "plr-replicate"
ONE_RADIO = "plr-1x2"
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
    mean_over_worse: float | None
    """As `mean_gain`, of the direct run with the higher mean."""
    p99_over_worse: float | None


NO_GAINS = Gains(0, None, None, None, None)


def better_direct(runs: Mapping[str, Outcome]) -> Outcome:
    """Of the two direct runs of one window, the one that missed less; of two alike the one with the lower mean."""
    return min((runs[name] for name in DIRECT), key=lambda run: (run.figures().miss_ratio, run.figures().mean_ms))


def compare(outcomes: Iterable[Outcome]) -> dict[str, dict[str, Comparison]]:
    """Scenario -> contender -> comparison, of runs that are not void."""
    return {scenario: _window(by_name) for scenario, by_name in figures_by_window(outcomes).items()}


def gains(windows: Windows) -> dict[str, Gains]:
    """Contender -> medians over the windows in which at least one of the two direct runs missed a deadline."""
    hard = [by_name for by_name in windows.values() if _is_hard(by_name)]
    names = dict.fromkeys(name for by_name in hard for name in by_name if name not in (*IDEALS, *DIRECT))
    return {name: _gains(name, [by_name for by_name in hard if name in by_name]) for name in names}


def one_radio_gain(windows: Windows) -> float | None:
    """How many times lower the median window's mean is with both radios than with one; None: nothing to compare."""
    both = [by_name for by_name in windows.values() if by_name.keys() >= {ONE_RADIO, SUREST}]
    return median(by_name[ONE_RADIO].mean_ms / by_name[SUREST].mean_ms for by_name in both)


def _is_hard(by_name: Mapping[str, Figures]) -> bool:
    directs = [by_name[direct] for direct in DIRECT if direct in by_name]
    return len(directs) == len(DIRECT) and any(direct.miss_ratio for direct in directs)


def _gains(contender: str, windows: Sequence[Mapping[str, Figures]]) -> Gains:
    means, p99s = (
        [(sorted(figure(by_name[direct]) for direct in DIRECT), figure(by_name[contender])) for by_name in windows]
        for figure in (attrgetter("mean_ms"), attrgetter("p99_ms"))
    )
    return Gains(
        len(windows),
        mean_gain=median(ratio(better, ours) for (better, _), ours in means),
        p99_gain=median(ratio(better, ours) for (better, _), ours in p99s),
        mean_over_worse=median(ratio(worse, ours) for (_, worse), ours in means),
        p99_over_worse=median(ratio(worse, ours) for (_, worse), ours in p99s),
    )


def _window(by_name: Mapping[str, Figures]) -> dict[str, Comparison]:
    return {name: _one(of, by_name) for name, of in by_name.items() if name not in IDEALS}


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
