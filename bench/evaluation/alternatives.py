"""Compares alternatives with `plr-replicate` in the same windows: the recorded drives of case A."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from bench.dataplane.statistics import median
from bench.evaluation.comparison import DIRECT, SUREST, better_direct
from bench.evaluation.outcome import Figures, by_window, together
from bench.evaluation.studies import is_recorded

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from bench.evaluation.outcome import Outcome

BETTER_DIRECT = "better direct"
"""The direct run that missed less in each window: a choice that nobody can make in advance."""
OTHERS = ("mptcp", "zenoh", "zenoh-drop")
COMPARED = ("miss_ratio", "unanswered_ratio", "mean_ms", "p50_ms", "p99_ms", "bytes_per_request")
"""Figures for which it is counted which contender is lower."""
PLR = ("plr-single", "plr-hedge", "plr-adaptive", SUREST)


@dataclass(frozen=True, slots=True)
class Pooled:
    """All requests of several windows as one run, and the median of the windows' tails."""

    figures: Figures
    median_p99_ms: float


@dataclass(frozen=True, slots=True)
class Beside:
    """An alternative and ours, over the windows in which both and both direct runs ran."""

    windows: int
    theirs: Pooled
    ours: Pooled
    lower: dict[str, tuple[int, int]]
    """Figure -> number of windows in which theirs is lower, and in which ours is; in the others they are equal."""


@dataclass(frozen=True, slots=True)
class Everywhere:
    """Contenders over the same windows."""

    windows: tuple[str, ...]
    contenders: dict[str, Pooled]


def pooled(runs: Sequence[Outcome]) -> Pooled:
    """Pool at least one run."""
    return Pooled(together(runs).figures(), median(run.figures().p99_ms for run in runs) or 0.0)


def beside(outcomes: Iterable[Outcome]) -> dict[str, Beside]:
    """Return contender -> comparison; those that never ran beside ours are left out."""
    drives = [one for one in outcomes if one.case == "A" and is_recorded(one.scenario)]
    windows = [runs for runs in by_window(drives).values() if runs.keys() >= {*DIRECT, SUREST}]
    pairs = {BETTER_DIRECT: [(better_direct(runs), runs[SUREST]) for runs in windows]}
    for name in OTHERS:
        pairs[name] = [(runs[name], runs[SUREST]) for runs in windows if name in runs]
    return {name: _beside(both) for name, both in pairs.items() if both}


def everywhere(outcomes: Iterable[Outcome], names: Sequence[str]) -> Everywhere | None:
    """Return the `names` that ran in every recorded drive in which the direct runs and the `PLR` ones of `names` ran.

    Returns None if there is no such drive.
    """
    drives = by_window(one for one in outcomes if one.case == "A" and is_recorded(one.scenario))
    needed = {*DIRECT, *(name for name in names if name in PLR)}
    windows = {window: runs for window, runs in drives.items() if runs.keys() >= needed}
    if not windows:
        return None
    found = {BETTER_DIRECT: pooled([better_direct(runs) for runs in windows.values()])}
    for name in names:
        if all(name in runs for runs in windows.values()):
            found[name] = pooled([runs[name] for runs in windows.values()])
    return Everywhere(tuple(windows), found)


def _beside(both: Sequence[tuple[Outcome, Outcome]]) -> Beside:
    lower = {}
    for figure in COMPARED:
        # Times are known to the microsecond: smaller differences are ties.
        values = [tuple(round(getattr(run.figures(), figure) or 0.0, 6) for run in pair) for pair in both]
        lower[figure] = (sum(one < other for one, other in values), sum(one > other for one, other in values))
    return Beside(len(both), pooled([one for one, _ in both]), pooled([other for _, other in both]), lower)
