"""Runs the parts, shows their tables, writes matcher.json and matcher.png."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from matplotlib.figure import Figure as Canvas
from rich.console import Console

from bench.dataplane.section import Findings
from bench.matcher import calibrated, live, speed, useful
from bench.matcher.targets import TARGETS
from bench.reporting.machine import machine
from bench.reporting.terminal import rich_table, show_verdicts
from lab.errors import LabConfigError

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable

    from bench.dataplane.section import Plot

PARTS = ("calibration", "useful", "speed", "live")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `python -m bench matcher`."""
    parser.add_argument(
        "--traces", type=Path, help="folder with index.json and NAME.csv.gz (see docs/develop/benchmarks.md)"
    )
    parser.add_argument("--quick", action="store_true", help="one trace of each family, no fleet of thousands")
    parser.add_argument("--only", choices=PARTS, help="run only this part")
    parser.add_argument(
        "--out", type=Path, default=Path("bench/results"), help="folder for the reports (default %(default)s)"
    )


def run(options: argparse.Namespace) -> int:
    """Measure and return the exit code: 1 if a target is missed, 2 if the traces are not readable."""
    console = Console(highlight=False)
    try:
        with console.status("matcher") as status:
            findings = _measure(options, status.update)
    except LabConfigError as error:
        console.print(str(error))
        return 2
    for table in findings.tables:
        console.print(rich_table(table))
    for note in findings.notes:
        console.print(note, soft_wrap=True)
    for name, value in findings.figures.items():
        console.print(f"{name}: {value if value is None or isinstance(value, int) else round(value, 4)}")
    show_verdicts(console, findings.figures, TARGETS)
    _write(findings, options)
    missed = any(target.met(findings.figures) is False for target in TARGETS)
    return 1 if missed and not options.quick else 0


def _measure(options: argparse.Namespace, say: Callable[[str], None]) -> Findings:
    whole = Findings()
    for part in PARTS:
        if options.only not in (None, part):
            continue
        if part == "calibration":
            findings = calibrated.measure(options.traces, say, quick=options.quick)
        elif part == "useful":
            findings = useful.measure(options.traces, say, quick=options.quick)
        elif part == "speed":
            findings = speed.measure(say, quick=options.quick)
        else:
            findings = live.measure(say)
        whole.figures |= findings.figures
        whole.tables += findings.tables
        whole.plots += findings.plots
        whole.notes += findings.notes
    return whole


def _write(findings: Findings, options: argparse.Namespace) -> None:
    options.out.mkdir(parents=True, exist_ok=True)
    verdicts = {target.key: target.met(findings.figures) for target in TARGETS}
    report = {**findings.figures, "verdicts": verdicts, "machine": machine(), "quick": options.quick}
    (options.out / "matcher.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    for plot in findings.plots:
        _draw(plot, options.out / "matcher.png")


def _draw(plot: Plot, file: Path) -> None:
    canvas = Canvas(figsize=(6, 6), layout="constrained")
    axes = canvas.subplots()
    low = 1e-3
    axes.plot((low, 1.0), (low, 1.0), color="grey", linewidth=1)
    for name, points in plot.points.items():
        xs, ys = [max(x, low) for x, _ in points], [max(y, low) for _, y in points]
        axes.scatter(xs, ys, s=8, alpha=0.6, label=name)
    axes.set(title=plot.title, xlabel=plot.x_label, ylabel=plot.y_label, xscale="log", yscale="log")
    axes.legend()
    canvas.savefig(file, dpi=120)
