"""Runs the sections, shows their tables, writes dataplane.json and dataplane.html."""

from __future__ import annotations

import json
import tempfile
import time
import traceback
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from bench.dataplane import page
from bench.dataplane.report import Report
from bench.dataplane.section import Context, Findings
from bench.dataplane.sections import SECTIONS
from bench.dataplane.targets import TARGETS
from bench.reporting.machine import machine
from bench.reporting.terminal import rich_table, show_verdicts
from lab.pressure import CpuPressure

if TYPE_CHECKING:
    import argparse

    from bench.dataplane.section import Section

DEFAULT_REPEATS = 3
QUICK_REPEATS = 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `python -m bench dataplane`."""
    names = [section.name for section in SECTIONS]
    parser.add_argument("--only", action="append", choices=names, help="measure this section only; may be repeated")
    parser.add_argument(
        "--quick", action="store_true", help="few requests and one repeat: shows that it works, not how fast"
    )
    parser.add_argument("--repeats", type=int, help=f"repeats whose median counts (default {DEFAULT_REPEATS})")
    parser.add_argument(
        "--out", type=Path, default=Path("bench/results"), help="folder for the reports (default %(default)s)"
    )


def run(options: argparse.Namespace) -> int:
    """Measure and return the exit code: 1 if a section failed or a measured target is missed."""
    console = Console(highlight=False)
    repeats = options.repeats or (QUICK_REPEATS if options.quick else DEFAULT_REPEATS)
    report = Report(machine(), options.quick, repeats)
    pressure = CpuPressure()
    failed = False
    for section in SECTIONS:
        if options.only and section.name not in options.only:
            continue
        started = time.monotonic()
        with tempfile.TemporaryDirectory(prefix="plr-bench-") as folder, console.status(section.title) as status:
            context = Context(Path(folder), repeats, options.quick, status.update)
            try:
                findings = section.measure(context)
            except Exception as error:  # the other sections still count
                traceback.print_exc()
                failed = True
                findings = Findings(notes=[f"failed: {error}"])
        report.add(section, findings, time.monotonic() - started)
        _show(console, section, findings)
        _write(report, options.out)
    report.machine["cpu_pressure"] = pressure.share()
    _write(report, options.out)
    show_verdicts(console, report.figures, TARGETS, report.ranges())
    console.print(f"written: {options.out / 'dataplane.json'} and {options.out / 'dataplane.html'}")
    missed = any(target.met(report.figures) is False for target in TARGETS)
    return 1 if failed or (missed and not options.quick) else 0


def _write(report: Report, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "dataplane.json").write_text(json.dumps(report.as_json(), indent=1) + "\n", encoding="utf-8")
    (folder / "dataplane.html").write_text(page.render(report), encoding="utf-8")


def _show(console: Console, section: Section, findings: Findings) -> None:
    for table in findings.tables:
        console.print(rich_table(table))
    for note in findings.notes:
        console.print(f"{section.name}: {note}", soft_wrap=True)
