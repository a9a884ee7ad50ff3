"""Two evaluations of the same windows: does every ratio come out alike?

A ratio is the median or the sum over few windows, each with its share of chance. How far two evaluations differ says
how many digits of a ratio are worth reading.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from bench.evaluation import paper
from bench.evaluation.comparison import IDEAL, gains
from bench.evaluation.ideal import IDEALS
from bench.evaluation.outcome import Outcome, by_window, together
from bench.evaluation.redundancy_costs import mode_costs
from bench.evaluation.studies import is_recorded, studies
from bench.reporting.tables import Table

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

ALIKE = 0.2
"""Two ratios that differ by no more came out alike."""
ENOUGH_MISSES = 30
"""A ratio of misses is compared when each of both has so many."""


@dataclass(frozen=True, slots=True)
class Repeat:
    """One ratio, measured twice."""

    first: float
    second: float

    @property
    def difference(self) -> float:
        """Of the second from the first, over the first."""
        return abs(self.second - self.first) / abs(self.first)


@dataclass(frozen=True, slots=True)
class Repeats:
    """What two evaluations have in common."""

    windows: int
    runs: int
    ratios: dict[str, Repeat]

    @property
    def largest(self) -> str | None:
        """The ratio that differs most."""
        return max(self.ratios, key=lambda name: self.ratios[name].difference, default=None)


def compare(first: Sequence[Outcome], second: Sequence[Outcome]) -> Repeats:
    """Compare two evaluations over the runs that both have, none void."""
    one, other = by_window(first), by_window(second)
    for window, runs in other.items():
        # Computed from the trace, not run: the same whenever it is done.
        runs.update({name: run for name, run in one.get(window, {}).items() if name in IDEALS and name not in runs})
    common = {window: [name for name in one.get(window, {}) if name in runs] for window, runs in other.items()}
    measured = {window: [name for name in names if name not in IDEALS] for window, names in common.items()}
    common = {window: names for window, names in common.items() if measured[window]}
    before, after = (
        _ratios([runs[window][name] for window, names in common.items() for name in names]) for runs in (one, other)
    )
    both = {name: Repeat(before[name], after[name]) for name in before if name in after and before[name]}
    return Repeats(len(common), sum(len(measured[window]) for window in common), both)


def _ratios(outcomes: Sequence[Outcome]) -> dict[str, float]:
    found: dict[str, float | None] = {}
    for name, gain in gains(outcomes).items():
        found[f"{name}: mean gain"] = gain.mean_gain
        found[f"{name}: P99 gain"] = gain.p99_gain
    for name, cost in mode_costs(outcomes).items():
        found[f"{name}: avoided"] = cost.avoided
        found[f"{name}: bytes over single"] = 1.0 + cost.extra_bytes
    for one in paper.ratios(studies(outcomes)):
        found[f"{one.paper.about}: over the worse"] = one.over_worse
        found[f"{one.paper.about}: over the better"] = one.over_better
        found[f"{one.paper.about}, pooled: over the worse"] = one.pooled_over_worse
        found[f"{one.paper.about}, pooled: over the better"] = one.pooled_over_better
    found |= _misses_over_ideal(by_window(one for one in outcomes if one.case == "A" and is_recorded(one.scenario)))
    return {name: value for name, value in found.items() if value is not None}


def _misses_over_ideal(windows: Mapping[str, Mapping[str, Outcome]]) -> dict[str, float]:
    found = {}
    for name in sorted({name for runs in windows.values() for name in runs} - set(IDEALS)):
        both = [(runs[name], runs[IDEAL]) for runs in windows.values() if runs.keys() >= {name, IDEAL}]
        if both:
            ours, ideal = (together(runs).figures() for runs in zip(*both, strict=True))
            if min(ours.miss_ratio, ideal.miss_ratio) * ours.requests >= ENOUGH_MISSES:
                found[f"{name}: misses over the ideal's"] = ours.miss_ratio / ideal.miss_ratio
    return found


def table(repeats: Repeats) -> Table:
    """For people; the largest differences first."""
    ordered = sorted(repeats.ratios.items(), key=lambda item: -item[1].difference)
    rows = tuple((name, one.first, one.second, f"{one.difference * 100:.0f} %") for name, one in ordered)
    title = f"The {repeats.runs} runs in {repeats.windows} windows that both evaluations have:"
    return Table(title, ("ratio", "first", "second", "difference"), rows)
