"""`python -m bench scenarios`: shows what can be replayed, the ideals' results, and the generator beside the traces."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from bench.evaluation.ideal import IDEALS, compute
from bench.evaluation.kinds import KINDS
from bench.evaluation.scenario import Scenario, read_scenarios
from bench.evaluation.trace_statistics import LAGS_S, SHOWN, PairStatistics, measure, stated
from bench.reporting.tables import Figure, Table
from bench.reporting.terminal import rich_table
from lab import LabConfigError
from lab.trace_folder import TraceEntry, read_folder
from plr.protos.base.errors import ConfigError

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

WIDE = 200
"""Columns if the output is not a terminal."""
RECORDED = {"drive": "drive-att-vz", "satellite": "drive-att-mob", "indoor": "walk-wifi-cellular-11"}
"""Kind of the generator -> the family of recorded traces that it stands for."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `python -m bench scenarios`."""
    parser.add_argument("--traces", type=Path, help="folder of recorded traces; default: only made-up scenarios")


def run(options: argparse.Namespace) -> int:
    """Show the tables and return the exit code, 2 if something is not readable."""
    try:
        traces = read_folder(options.traces) if options.traces else []
        tables = [_ideals(read_scenarios(traces)), _statistics(traces)]
    except (LabConfigError, ConfigError) as error:
        print(error, file=sys.stderr)
        return 2
    for table in tables:
        Console(highlight=False, width=None if sys.stdout.isatty() else WIDE).print(rich_table(table))
    return 0


def _ideals(scenarios: Sequence[Scenario]) -> Table:
    columns = ["", "case", *(f"{name} {what}" for name in IDEALS for what in ("missed", "P99 ms"))]
    rows = []
    for scenario in scenarios:
        row: list[str | Figure] = [scenario.name, scenario.case]
        for name in IDEALS:
            figures = compute(scenario, name).figures()
            row += [figures.miss_ratio, figures.p99_ms]
        rows.append(tuple(row))
    return Table("scenarios, and what their networks allow", tuple(columns), tuple(rows))


def _statistics(traces: Sequence[TraceEntry]) -> Table:
    """Return the generator's kinds as stated, each with the recorded family that it stands for, if there is one."""
    rows = []
    for name, kind in KINDS.items():
        rows += _rows(f"{name}, stated", stated(kind))
        family = [entry.load() for entry in traces if entry.name.rpartition("-")[0] == RECORDED.get(name)]
        if family:
            rows += _rows(f"{name}, {RECORDED[name]}", measure(family))
    columns = (
        "",
        *(f"{share:.0%} Mbit/s" for share in SHOWN),
        *(f"autocorr. {lag_s:g} s" for lag_s in LAGS_S),
        *("slow", "dark", "dark s", "Spearman", "lift"),
    )
    return Table("the generator's kinds, blackouts aside, and recorded families", columns, tuple(rows))


def _rows(name: str, found: PairStatistics) -> list[tuple[str | Figure, ...]]:
    rows: list[tuple[str | Figure, ...]] = []
    for letter, path in (("a", found.a), ("b", found.b)):
        both = (found.spearman, found.low_lift) if letter == "a" else (None, None)
        rates = (rate / 1e3 for rate in path.rates_kbps)
        shares = (path.low_share, path.outage_share, path.outage_s)
        rows.append((f"{name}, {letter}", *rates, *path.autocorrelation, *shares, *both))
    return rows
