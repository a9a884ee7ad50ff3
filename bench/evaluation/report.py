"""Derives everything from the records of runs: verdicts, figures, tables, charts; `page` and `summary` show it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from bench.dataplane.statistics import median
from bench.evaluation import alternatives, charts, findings, paper, repeats
from bench.evaluation.comparison import DIRECT, IDEAL, SUREST, better_direct, compare, gains, over_direct
from bench.evaluation.ideal import COMPUTED, ORACLE
from bench.evaluation.measured import Measured
from bench.evaluation.outcome import Outcome, by_window, figures_by_window
from bench.evaluation.redundancy_costs import MODES, NEEDED, mode_costs
from bench.evaluation.studies import Study, pool, ranked, studies
from bench.evaluation.targets import TARGETS
from bench.reporting.tables import Figure, Table

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from bench.evaluation.charts import Chart
    from bench.evaluation.drives import Drives
    from bench.evaluation.findings import Evidence
    from bench.evaluation.outcome import Figures, Windows
    from bench.evaluation.redundancy_costs import ModeCost

RUNS = "evaluation"
"""Folder of the records, within the folder of the reports."""
_GAINS = ("mean", "p99")
_COLUMNS = ("", "missed", "never answered", "mean ms", "P50 ms", "P99 ms", "kB/request")
_MODE_COLUMNS = (
    "",
    "windows",
    "missed",
    "kB/request",
    "avoided misses (plr-replicate = 100 %)",
    "bytes beyond plr-single",
)


@dataclass(frozen=True, slots=True)
class Section:
    """Charts and tables under one title."""

    title: str
    about: str
    charts: tuple[Chart, ...]
    tables: tuple[Table, ...]
    details: tuple[Table, ...] = ()
    """Tables for a closer look."""


@dataclass(frozen=True, slots=True)
class Report:
    """Everything that a report shows."""

    about: str
    evidence: Evidence
    ratios: Table
    sections: tuple[Section, ...]


def read_records(folder: Path, scenario: str = "*") -> list[Outcome]:
    """Return the runs recorded in a folder of reports; raises ValueError, which names the file, if unreadable."""
    return [Outcome.read(file) for file in sorted((folder / RUNS).glob(f"{scenario}/*.json"))]


def gather(outcomes: Sequence[Outcome], again: Measured | None = None) -> Report:
    """Make a report from at least one run; `again` is another evaluation of the same windows."""
    found = studies(outcomes)
    void = sum(bool(one.disturbances) for one in outcomes)
    windows = len({one.scenario for one in outcomes})
    on = "".join(f", {key}: {value}" for key, value in machine_of(outcomes).items())
    return Report(
        about=f"{len(outcomes)} runs in {windows} windows, {void} of them void{on}",
        evidence=findings.gather(outcomes, again),
        ratios=paper.table(paper.ratios(found)),
        sections=(
            *_repeats(outcomes, again),
            *_modes(outcomes),
            *(_study(study, outcomes) for study in found),
            *_void(outcomes),
        ),
    )


def machine_of(outcomes: Iterable[Outcome]) -> dict[str, Any]:
    """Return the machine and time of the newest run; empty if no record has them."""
    known: list[dict[str, Any]] = [one.conditions["machine"] for one in outcomes if "machine" in one.conditions]
    return max(known, key=lambda machine: str(machine.get("measured_at", "")), default={})


def as_json(
    outcomes: Sequence[Outcome], failed: Sequence[str], again: Measured | None = None, drives: Drives | None = None
) -> dict[str, Any]:
    """Return every figure of the report; `drives` says which recorded windows are one drive, if known."""
    evidence = findings.gather(outcomes, again)
    found = studies(outcomes)
    runs: dict[str, dict[str, Any]] = {}
    compared = compare(outcomes)
    windows = figures_by_window(outcomes)
    for outcome in outcomes:
        comparison = compared.get(outcome.scenario, {}).get(outcome.contender)
        runs.setdefault(outcome.scenario, {})[outcome.contender] = {
            **asdict(outcome.figures()),
            **(asdict(comparison) if comparison else {}),
            "case": outcome.case,
            "deadline_ms": outcome.deadline_ms,
            "explained": outcome.conditions.get("explained", []),
            "void": list(outcome.disturbances),
        }
    return {
        **{target.key: None for target in TARGETS},
        **evidence.figures,
        "verdicts": {target.key: target.met(evidence.figures) for target in TARGETS},
        "from": evidence.notes,
        "paper": [asdict(ratio) for ratio in paper.ratios(found)],
        "studies": {study.name: _pooled_as_json(study) for study in found},
        "gains": {name: asdict(gain) for name, gain in gains(windows).items()},
        "redundancy_modes": {name: asdict(cost) for name, cost in mode_costs(windows).items()},
        "others": {name: asdict(one) for name, one in alternatives.beside(outcomes).items()},
        "drives": None if drives is None else asdict(drives),
        "everywhere": _everywhere_as_json(outcomes, drives),
        "reproduced": _repeats_as_json(outcomes, again),
        "runs": runs,
        "failed": list(failed),
        "machine": machine_of(outcomes),
        "measured": _measured_as_json(outcomes),
    }


def window_table(scenario: str, outcomes: Iterable[Outcome]) -> Table:
    """Return a table of all contenders in one window."""
    runs = {one.contender: one for one in outcomes if one.scenario == scenario}
    rows = tuple(
        (*_row(name, runs[name].figures()), "void" if runs[name].disturbances else "") for name in ranked(runs)
    )
    one = next(iter(runs.values()))
    return Table(
        f"{scenario}: {len(one.requests)} requests, deadline {one.deadline_ms:g} ms", (*_COLUMNS, "void"), rows
    )


def modes_table(costs: Mapping[str, ModeCost]) -> Table:
    """Return a table of what each redundancy mode avoids and costs."""
    rows = tuple(
        (
            name,
            cost.windows,
            f"{cost.miss_ratio:.1%}",
            cost.bytes_per_request / 1e3,
            None if cost.avoided is None else f"{cost.avoided:.1%}",
            f"{cost.extra_bytes:+.1%}",
        )
        for name, cost in costs.items()
    )
    title = "All windows in which direct-a, direct-b, plr-single and plr-replicate ran:"
    return Table(title, _MODE_COLUMNS, rows)


def _repeats(outcomes: Sequence[Outcome], again: Measured | None) -> list[Section]:
    if again is None:
        return []
    return [
        Section(
            "Repeated",
            "A second evaluation ran the same windows. A gain is the mean or P99 of the better direct run, divided by "
            "that of the contender. Only windows in which a direct run misses a request count. Rows with "
            "`median` show the median of the gains in these windows, the other rows with `gain` their geometric mean. "
            "Gains over the worse use the worse direct run instead.",
            (),
            (repeats.table(repeats.compare(Measured.of(outcomes), again)),),
        )
    ]


def _modes(outcomes: Sequence[Outcome]) -> list[Section]:
    costs = mode_costs(figures_by_window(outcomes))
    shared = pool(by_window(outcomes), (*DIRECT, *MODES), NEEDED)
    beside = mode_costs(figures_by_window(run for runs in shared.runs.values() for run in runs)) if shared else {}
    drawn = (charts.modes("modes", beside),) if beside else ()
    about = "Extra copies avoid misses and cost bytes: how many of each."
    return [Section("Redundancy modes", about, drawn, (modes_table(costs),))] if costs else []


def _study(study: Study, outcomes: Sequence[Outcome]) -> Section:
    drawn: list[Chart] = []
    tables: tuple[Table, ...] = ()
    about = ""
    hardest = study.hardest(charts.ALONG)
    if hardest is not None:
        drawn.append(charts.along(f"{study.name}-along", hardest, study.windows[hardest]))
    shared = pool(study.windows)
    if shared is not None:
        figures = {name: shared.together(name).figures() for name in shared.runs}
        drawn += [
            charts.distributions(f"{study.name}-distributions", shared),
            charts.bars(f"{study.name}-bars", figures),
            charts.deadlines(f"{study.name}-deadlines", shared),
        ]
        about = f"The table and the charts cover {len(shared.windows)} of {len(study.windows)} windows: those in which "
        about += "every contender in the table ran."
        if shared.left_out:
            left_out = ", ".join(f"{name} ({count})" for name, count in shared.left_out.items())
            about += f" Other contenders ran in fewer of these windows, and are left out: {left_out}."
        rows = tuple(_row(name, figures[name]) for name in ranked(figures))
        tables = (Table("All requests of these windows together:", _COLUMNS, rows),)
    details = tuple(window_table(window, outcomes) for window in study.windows)
    return Section(study.title, about, tuple(drawn), tables, details)


def _void(outcomes: Sequence[Outcome]) -> list[Section]:
    rows = tuple((one.scenario, one.contender, "; ".join(one.disturbances)) for one in outcomes if one.disturbances)
    table = Table("", ("", "contender", "why"), rows)
    return [Section("Void runs", "They count nowhere.", (), (table,))] if rows else []


def _row(name: str, figures: Figures) -> tuple[str | Figure, ...]:
    kilobytes = None if figures.bytes_per_request is None else figures.bytes_per_request / 1e3
    shares = (f"{figures.miss_ratio:.1%}", f"{figures.unanswered_ratio:.1%}")
    return (name, *shares, figures.mean_ms, figures.p50_ms, figures.p99_ms, kilobytes)


def _pooled_as_json(study: Study) -> dict[str, Any]:
    shared = pool(study.windows)
    if shared is None:
        return {"windows": []}
    pools = {name: alternatives.pooled(runs) for name, runs in shared.runs.items()}
    if shared.runs.keys() >= {*DIRECT}:
        better = [better_direct(study.windows[window]) for window in shared.windows]
        pools = {alternatives.BETTER_DIRECT: alternatives.pooled(better), **pools}
    contenders = {name: {**asdict(one.figures), "median_p99_ms": one.median_p99_ms} for name, one in pools.items()}
    return {"windows": list(shared.windows), "contenders": contenders}


def _everywhere_as_json(outcomes: Sequence[Outcome], drives: Drives | None) -> list[dict[str, Any]]:
    """Return the results in all drives, then in those in which every mode ran."""
    found: list[dict[str, Any]] = []
    windows = figures_by_window(outcomes)
    for names in (
        (*alternatives.OTHERS, SUREST, IDEAL, ORACLE),
        (*alternatives.OTHERS, *alternatives.PLR, IDEAL, ORACLE),
    ):
        one = alternatives.everywhere(outcomes, names)
        if one is None:
            continue
        if found and len(one.windows) == len(found[0]["windows"]):
            found.clear()  # the modes ran in all of them: one table shows all contenders
        kept = {name: windows[name] for name in one.windows}
        contenders = {
            name: {
                **asdict(pooled.figures),
                "median_p99_ms": pooled.median_p99_ms,
                "distinct_miss_ratio": _alike(kept, name, drives),
            }
            for name, pooled in one.contenders.items()
        }
        gains = {f"median_{told}_gain": median(over_direct(kept.values(), SUREST, f"{told}_ms")) for told in _GAINS}
        hard = sum(any(by_name[direct].miss_ratio for direct in DIRECT) for by_name in kept.values())
        found.append({"windows": list(kept), "hard_windows": hard, "contenders": contenders, **gains})
    return found


def _alike(windows: Windows, contender: str, drives: Drives | None) -> float | None:
    """Return its miss ratio with equal weight for each drive, however many windows replay it; None if unknown."""
    if drives is None:
        return None
    of_drives = [
        [_miss_ratio(windows[name], contender) for name in names if name in windows] for names in drives.distinct
    ]
    means = [sum(ratios) / len(ratios) for ratios in of_drives if ratios]
    return sum(means) / len(means) if means else None


def _miss_ratio(by_name: Mapping[str, Figures], contender: str) -> float:
    if contender == alternatives.BETTER_DIRECT:
        return min(by_name[direct].miss_ratio for direct in DIRECT)
    return by_name[contender].miss_ratio


def _measured_as_json(outcomes: Iterable[Outcome]) -> dict[str, Any]:
    """Return how many were run, when, and at which commits; early runs recorded no commit."""
    kept = [one for one in outcomes if one.contender not in COMPUTED]
    known: list[dict[str, Any]] = [one.conditions["machine"] for one in kept if "machine" in one.conditions]
    times = sorted(str(one["measured_at"]) for one in known if "measured_at" in one)
    return {
        "runs": len(kept),
        "from": times[0] if times else None,
        "to": times[-1] if times else None,
        "commits": sorted({str(one["commit"]) for one in known if "commit" in one}),
    }


def _repeats_as_json(outcomes: Sequence[Outcome], again: Measured | None) -> dict[str, Any] | None:
    if again is None:
        return None
    found = repeats.compare(Measured.of(outcomes), again)
    ratios = {name: {**asdict(one), "difference": one.difference} for name, one in found.ratios.items()}
    return {"windows": found.windows, "runs": found.runs, "ratios": ratios}
