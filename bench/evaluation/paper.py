"""Compares the paper's ratios (sections V.A and V.B, with its errata) with ours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from bench.dataplane.statistics import geometric_mean, ratio
from bench.evaluation.comparison import DIRECT, SUREST, hard_windows, over_direct
from bench.evaluation.outcome import Outcome, together
from bench.reporting.tables import Table

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from bench.evaluation.outcome import Figures
    from bench.evaluation.studies import Study


@dataclass(frozen=True, slots=True)
class PaperRatio:
    """How many times lower the paper's system is than a single path; None if not printed."""

    case: str
    about: str
    figure: str
    """`mean_ms` or `p99_ms`."""
    over_worse: float | None
    over_better: float | None


PRINTED = (
    PaperRatio("A", "driving, P99", "p99_ms", 3.7, 2.46),
    PaperRatio("A", "driving, mean", "mean_ms", 2.73, 1.90),
    PaperRatio("B", "indoor tracking, P99", "p99_ms", None, 1.21),
    PaperRatio("B", "indoor tracking, mean", "mean_ms", None, 1.36),
    PaperRatio("C", "two Wi-Fi, P99", "p99_ms", None, None),
    PaperRatio("C", "two Wi-Fi, mean", "mean_ms", None, None),
)


@dataclass(frozen=True, slots=True)
class OurRatio:
    """The ratio of `plr-replicate` in the windows of one study; None if there is nothing to compare."""

    paper: PaperRatio
    recorded: bool
    windows: int
    hard_windows: int
    """Number of windows in which a direct run misses anything."""
    over_worse: float | None
    """Geometric mean over the hard windows."""
    over_better: float | None
    pooled_over_worse: float | None
    """Ratio with all requests of all windows as one run, against the worse direct run of each window."""
    pooled_over_better: float | None


def ratios(studies: Sequence[Study]) -> list[OurRatio]:
    """Return a ratio for each printed one, from the recorded windows of its case, else from generated ones."""
    found = []
    for paper in PRINTED:
        of_case = [study for study in studies if study.case == paper.case]
        chosen = [study for study in of_case if study.recorded] or of_case
        windows = [r for study in chosen for r in study.windows.values() if r.keys() >= {*DIRECT, SUREST}]
        if windows:
            found.append(_ratio(paper, any(study.recorded for study in chosen), windows))
    return found


def _ratio(paper: PaperRatio, recorded: bool, windows: Sequence[Mapping[str, Outcome]]) -> OurRatio:
    # The better direct run of each window, by this figure, comes first.
    directs = [sorted((runs[name] for name in DIRECT), key=lambda run: _value(run, paper)) for runs in windows]
    ours = [runs[SUREST] for runs in windows]
    figures = [{name: run.figures() for name, run in runs.items()} for runs in windows]
    hard = hard_windows(figures, SUREST)

    def pooled(rank: int) -> float | None:
        return ratio(_value(together([pair[rank] for pair in directs]), paper), _value(together(ours), paper))

    return OurRatio(
        paper,
        recorded,
        len(windows),
        len(hard),
        geometric_mean(over_direct(hard, SUREST, paper.figure, max)),
        geometric_mean(over_direct(hard, SUREST, paper.figure)),
        pooled(1),
        pooled(0),
    )


def _value(run: Outcome, paper: PaperRatio) -> float:
    figures: Figures = run.figures()
    return figures.p99_ms if paper.figure == "p99_ms" else figures.mean_ms


def table(found: Sequence[OurRatio]) -> Table:
    """Return the ratios as a table."""
    columns = (
        "",
        "paper: over the worse path",
        "over the better",
        "ours, mean of windows: over the worse",
        "over the better",
        "windows",
        "ours, pooled: over the worse",
        "over the better",
        "windows",
    )
    rows = tuple(
        (
            f"{one.paper.about}{'' if one.recorded else ' (made up)'}",
            one.paper.over_worse,
            one.paper.over_better,
            one.over_worse,
            one.over_better,
            one.hard_windows,
            one.pooled_over_worse,
            one.pooled_over_better,
            one.windows,
        )
        for one in found
    )
    return Table(
        "How many times lower the latency is than over a single path. A request without an answer counts as 10 s, so "
        "no P99 is above 10 s.",
        columns,
        rows,
    )
