"""All that the records of runs say: verdicts, figures, tables, charts; `page` and `summary` show it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from bench.evaluation import charts, findings, others, paper, repeats
from bench.evaluation.comparison import DIRECT, better_direct, compare, gains
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
    from bench.evaluation.findings import Evidence
    from bench.evaluation.outcome import Figures
    from bench.evaluation.redundancy_costs import ModeCost

RUNS = "evaluation"
"""Folder of the records, within that of the reports."""
_COLUMNS = ("", "missed", "never answered", "mean ms", "P50 ms", "P99 ms", "kB/request")
_MODE_COLUMNS = ("", "windows", "missed", "kB/request", "of replicate's avoided misses", "extra bytes over single")


@dataclass(frozen=True, slots=True)
class Section:
    """Charts and tables under one title."""

    title: str
    about: str
    charts: tuple[Chart, ...]
    tables: tuple[Table, ...]
    details: tuple[Table, ...] = ()
    """For those who look closer."""


@dataclass(frozen=True, slots=True)
class Report:
    """Everything."""

    about: str
    evidence: Evidence
    ratios: Table
    sections: tuple[Section, ...]


def read_records(folder: Path, scenario: str = "*") -> list[Outcome]:
    """All runs, of one scenario, recorded in a folder of reports. Raises ValueError: not readable; names the file."""
    return [Outcome.read(file) for file in sorted((folder / RUNS).glob(f"{scenario}/*.json"))]


def gather(outcomes: Sequence[Outcome], again: Measured | None = None) -> Report:
    """Everything, from at least one run; `again`: another evaluation of the same windows."""
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
    """What the newest run was measured on, and when; empty: no record says."""
    known: list[dict[str, Any]] = [one.conditions["machine"] for one in outcomes if "machine" in one.conditions]
    return max(known, key=lambda machine: str(machine.get("measured_at", "")), default={})


def as_json(outcomes: Sequence[Outcome], failed: Sequence[str], again: Measured | None = None) -> dict[str, Any]:
    """Every figure of the report."""
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
        "others": {name: asdict(one) for name, one in others.beside(outcomes).items()},
        "reproduced": _repeats_as_json(outcomes, again),
        "runs": runs,
        "failed": list(failed),
        "machine": machine_of(outcomes),
    }


def window_table(scenario: str, outcomes: Iterable[Outcome]) -> Table:
    """What everybody did in one window."""
    runs = {one.contender: one for one in outcomes if one.scenario == scenario}
    rows = tuple(
        (*_row(name, runs[name].figures()), "void" if runs[name].disturbances else "") for name in ranked(runs)
    )
    one = next(iter(runs.values()))
    return Table(
        f"{scenario}: {len(one.requests)} requests, deadline {one.deadline_ms:g} ms", (*_COLUMNS, "void"), rows
    )


def modes_table(costs: Mapping[str, ModeCost]) -> Table:
    """What each redundancy mode avoids and costs."""
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
    title = "redundancy modes, over the windows where direct-a, direct-b, plr-single and plr-replicate ran"
    return Table(title, _MODE_COLUMNS, rows)


def _repeats(outcomes: Sequence[Outcome], again: Measured | None) -> list[Section]:
    if again is None:
        return []
    return [
        Section(
            "Repeated",
            "Two evaluations of the same windows.",
            (),
            (repeats.table(repeats.compare(Measured.of(outcomes), again)),),
        )
    ]


def _modes(outcomes: Sequence[Outcome]) -> list[Section]:
    costs = mode_costs(figures_by_window(outcomes))
    shared = pool(by_window(outcomes), (*DIRECT, *MODES), NEEDED)
    beside = mode_costs(figures_by_window(run for runs in shared.runs.values() for run in runs)) if shared else {}
    drawn = (charts.modes("modes", beside),) if beside else ()
    about = "What further copies avoid and what they cost."
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
        about = f"Pooled over the {len(shared.windows)} of {len(study.windows)} windows in which all of these ran."
        if shared.left_out:
            left_out = ", ".join(f"{name} ({count})" for name, count in shared.left_out.items())
            about += f" Left out, as they ran in fewer of them: {left_out}."
        rows = tuple(_row(name, figures[name]) for name in ranked(figures))
        tables = (Table("all these windows together", _COLUMNS, rows),)
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
    pools = {name: others.pooled(runs) for name, runs in shared.runs.items()}
    if shared.runs.keys() >= {*DIRECT}:
        better = [better_direct(study.windows[window]) for window in shared.windows]
        pools = {others.BETTER_DIRECT: others.pooled(better), **pools}
    contenders = {name: {**asdict(one.figures), "median_p99_ms": one.median_p99_ms} for name, one in pools.items()}
    return {"windows": list(shared.windows), "contenders": contenders}


def _repeats_as_json(outcomes: Sequence[Outcome], again: Measured | None) -> dict[str, Any] | None:
    if again is None:
        return None
    found = repeats.compare(Measured.of(outcomes), again)
    ratios = {name: {**asdict(one), "difference": one.difference} for name, one in found.ratios.items()}
    return {"windows": found.windows, "runs": found.runs, "ratios": ratios}
