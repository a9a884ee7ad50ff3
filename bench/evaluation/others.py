"""What a user could take instead, beside `plr-replicate` in the same windows: the recorded drives of case A."""

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
"""In each window the direct run that missed less: a choice that nobody can make beforehand."""
OTHERS = ("mptcp", "zenoh", "zenoh-drop")
PLR = ("plr-single", "plr-hedge", "plr-adaptive", SUREST)


@dataclass(frozen=True, slots=True)
class Pooled:
    """All requests of several windows as one run, and the middle one of the windows' tails."""

    figures: Figures
    median_p99_ms: float


@dataclass(frozen=True, slots=True)
class Beside:
    """One of them and ours, over the windows in which both ran, and both direct runs."""

    windows: int
    theirs: Pooled
    ours: Pooled


def pooled(runs: Sequence[Outcome]) -> Pooled:
    """Of at least one run."""
    return Pooled(together(runs).figures(), median(run.figures().p99_ms for run in runs) or 0.0)


def beside(outcomes: Iterable[Outcome]) -> dict[str, Beside]:
    """Contender -> comparison; those that never ran beside ours are left out."""
    drives = [one for one in outcomes if one.case == "A" and is_recorded(one.scenario)]
    windows = [runs for runs in by_window(drives).values() if runs.keys() >= {*DIRECT, SUREST}]
    pairs = {BETTER_DIRECT: [(better_direct(runs), runs[SUREST]) for runs in windows]}
    for name in OTHERS:
        pairs[name] = [(runs[name], runs[SUREST]) for runs in windows if name in runs]
    return {
        name: Beside(len(both), pooled([theirs for theirs, _ in both]), pooled([ours for _, ours in both]))
        for name, both in pairs.items()
        if both
    }
