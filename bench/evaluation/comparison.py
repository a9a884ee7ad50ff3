"""Compares contenders in the same windows: with the better direct path, and with what the networks allow."""

from __future__ import annotations

from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING

from bench.dataplane.statistics import difference, geometric_mean, median, ratio
from bench.evaluation.ideal import COMPUTED
from bench.evaluation.outcome import figures_by_window

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from bench.evaluation.outcome import Figures, Outcome, Windows

DIRECT = ("direct-a", "direct-b")
SUREST = "plr-replicate"
ONE_RADIO = "plr-1x2"
IDEAL = "ideal"


@dataclass(frozen=True, slots=True)
class Comparison:
    """One contender in one window; None where its counterpart was not run, or is void."""

    mean_gain: float | None
    """How many times lower its mean is than the lower mean of the two direct runs."""
    p99_gain: float | None
    """The same for the 99th percentile."""
    miss_over_ideal: float | None
    """Its miss ratio minus the ideal's."""
    p99_over_ideal: float | None
    """Its 99th percentile over the ideal's."""


@dataclass(frozen=True, slots=True)
class Gains:
    """How many times lower one contender's figures are than the better direct run's, over windows.

    The mean of ratios is the geometric mean. It varies less than the median from one evaluation to the next: with a
    dozen windows the median depends on the two in the middle.
    """

    windows: int
    mean_gain: float | None
    p99_gain: float | None
    median_mean_gain: float | None
    median_p99_gain: float | None


def better_direct(runs: Mapping[str, Outcome]) -> Outcome:
    """Return the direct run of a window that missed less; of two equal ones, that with the lower mean."""
    return min((runs[name] for name in DIRECT), key=lambda run: (run.figures().miss_ratio, run.figures().mean_ms))


def compare(outcomes: Iterable[Outcome]) -> dict[str, dict[str, Comparison]]:
    """Return scenario -> contender -> comparison, for runs that are not void."""
    return {scenario: _window(by_name) for scenario, by_name in figures_by_window(outcomes).items()}


def gains(windows: Windows) -> dict[str, Gains]:
    """Return contender -> gains over its hard windows."""
    names = dict.fromkeys(name for by_name in windows.values() for name in by_name if name not in (*COMPUTED, *DIRECT))
    found = {name: _gains(name, hard_windows(windows.values(), name)) for name in names}
    return {name: one for name, one in found.items() if one.windows}


def hard_windows(windows: Iterable[Mapping[str, Figures]], contender: str) -> list[Mapping[str, Figures]]:
    """Return the windows in which it and both direct runs ran, and at least one of these missed a deadline."""
    return [by_name for by_name in windows if contender in by_name and _is_hard(by_name)]


def over_direct(
    windows: Iterable[Mapping[str, Figures]],
    contender: str,
    figure: str,
    direct: Callable[[Iterable[float]], float] = min,
) -> list[float | None]:
    """Return by window how many times lower a figure is than the better direct run's; `direct=max`: the worse one's."""
    value = attrgetter(figure)
    return [ratio(direct(value(one[name]) for name in DIRECT), value(one[contender])) for one in windows]


def one_radio_gain(windows: Windows) -> float | None:
    """Return how many times lower the median window's mean is with both radios than with one; None without data."""
    both = [by_name for by_name in windows.values() if by_name.keys() >= {ONE_RADIO, SUREST}]
    return median(by_name[ONE_RADIO].mean_ms / by_name[SUREST].mean_ms for by_name in both)


def _is_hard(by_name: Mapping[str, Figures]) -> bool:
    directs = [by_name[direct] for direct in DIRECT if direct in by_name]
    return len(directs) == len(DIRECT) and any(direct.miss_ratio for direct in directs)


def _gains(contender: str, windows: Sequence[Mapping[str, Figures]]) -> Gains:
    means, p99s = (over_direct(windows, contender, figure) for figure in ("mean_ms", "p99_ms"))
    return Gains(len(windows), geometric_mean(means), geometric_mean(p99s), median(means), median(p99s))


def _window(by_name: Mapping[str, Figures]) -> dict[str, Comparison]:
    return {name: _one(of, by_name) for name, of in by_name.items() if name not in COMPUTED}


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
