"""Compares two evaluations of the same windows: does every ratio come out alike?

A ratio is a mean or a sum over few windows, each partly random. The difference between two evaluations shows how many
digits of a ratio are meaningful.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from bench.dataplane.statistics import geometric_mean
from bench.evaluation.comparison import IDEAL, SUREST, gains, hard_windows, one_radio_gain, over_direct
from bench.evaluation.ideal import COMPUTED
from bench.evaluation.redundancy_costs import mode_costs
from bench.evaluation.studies import is_recorded, study_of
from bench.reporting.tables import Table

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from bench.evaluation.measured import Measured
    from bench.evaluation.outcome import Figures, Windows

ALIKE = 0.2
"""Relative difference up to which two ratios count as alike."""
ENOUGH_MISSES = 30
"""A ratio of misses is compared only if both sides have at least this many."""


@dataclass(frozen=True, slots=True)
class Repeat:
    """One ratio, measured twice."""

    first: float
    second: float

    @property
    def difference(self) -> float:
        """Difference of the second from the first, relative to the first."""
        return abs(self.second - self.first) / abs(self.first)


@dataclass(frozen=True, slots=True)
class Repeats:
    """What two evaluations have in common."""

    windows: int
    runs: int
    ratios: dict[str, Repeat]

    @property
    def largest(self) -> str | None:
        """Name of the ratio that differs most."""
        return max(self.ratios, key=lambda name: self.ratios[name].difference, default=None)


def compare(first: Measured, second: Measured) -> Repeats:
    """Compare two evaluations over the runs that both have."""
    one, other = dict(first.windows), dict(second.windows)
    runs = {scenario: _measured(one.get(scenario, {}), by_name) for scenario, by_name in other.items()}
    runs = {scenario: names for scenario, names in runs.items() if names}
    before, after = {}, {}
    for scenario, names in runs.items():
        # Computed from the trace, not run: the result is always the same.
        ideals = {name: of for by in (other, one) for name, of in by[scenario].items() if name in COMPUTED}
        before[scenario] = ideals | {name: one[scenario][name] for name in names}
        after[scenario] = ideals | {name: other[scenario][name] for name in names}
    of_first, of_second = (_ratios(windows, first.cases) for windows in (before, after))
    both = {name: Repeat(of_first[name], of_second[name]) for name in of_first if name in of_second and of_first[name]}
    return Repeats(len(runs), sum(map(len, runs.values())), both)


def _measured(one: Mapping[str, Figures], other: Mapping[str, Figures]) -> list[str]:
    return [name for name in one if name in other and name not in COMPUTED]


def _ratios(windows: Windows, cases: Mapping[str, str]) -> dict[str, float]:
    studies: dict[str, dict[str, Mapping[str, Figures]]] = {}
    for scenario, by_name in windows.items():
        studies.setdefault(study_of(scenario, cases[scenario]), {})[scenario] = by_name
    found: dict[str, float | None] = {}
    for study, of_study in sorted(studies.items()):
        for name, gain in gains(of_study).items():
            found[f"{study}, {name}: mean gain"] = gain.mean_gain
            found[f"{study}, {name}: P99 gain"] = gain.p99_gain
            found[f"{study}, {name}: median mean gain"] = gain.median_mean_gain
            found[f"{study}, {name}: median P99 gain"] = gain.median_p99_gain
        hard = hard_windows(of_study.values(), SUREST)
        for told, figure in (("mean", "mean_ms"), ("P99", "p99_ms")):
            worse = geometric_mean(over_direct(hard, SUREST, figure, max))
            found[f"{study}, {SUREST}: {told} gain over the worse"] = worse
        found[f"{study}: mean with one radio over that with both"] = one_radio_gain(of_study)
    for name, cost in mode_costs(windows).items():
        found[f"{name}: avoided"] = cost.avoided
        found[f"{name}: bytes over single"] = 1.0 + cost.extra_bytes
    drives = [of for scenario, of in windows.items() if cases[scenario] == "A" and is_recorded(scenario)]
    return {name: value for name, value in (found | _misses_over_ideal(drives)).items() if value is not None}


def _misses_over_ideal(windows: Iterable[Mapping[str, Figures]]) -> dict[str, float]:
    misses: dict[str, list[tuple[float, float]]] = {}
    for by_name in windows:
        for name in by_name.keys() - set(COMPUTED) if IDEAL in by_name else ():
            misses.setdefault(name, []).append((by_name[name].misses, by_name[IDEAL].misses))
    sums = {name: (sum(ours for ours, _ in both), sum(ideal for _, ideal in both)) for name, both in misses.items()}
    return {
        f"{name}: misses over the ideal's": ours / ideal
        for name, (ours, ideal) in sorted(sums.items())
        if min(ours, ideal) >= ENOUGH_MISSES
    }


def table(repeats: Repeats) -> Table:
    """Return a table with the largest differences first."""
    ordered = sorted(repeats.ratios.items(), key=lambda item: -item[1].difference)
    rows = tuple((name, one.first, one.second, f"{one.difference * 100:.0f} %") for name, one in ordered)
    title = f"Both evaluations have {repeats.runs} runs in {repeats.windows} windows:"
    return Table(title, ("ratio", "first", "second", "difference"), rows)
