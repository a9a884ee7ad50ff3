"""Runs the parts, shows their tables, writes matcher.json and matcher.png."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from matplotlib.figure import Figure as Canvas
from rich.console import Console

from bench.dataplane.command import rich_table
from bench.dataplane.report import machine
from bench.dataplane.section import Findings
from bench.matcher import calibrated, speed
from bench.netlab.errors import LabConfigError

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Mapping

    from bench.dataplane.section import Figure, Plot

WANTED_SHARE = 0.9
"""Cells whose observed ratio the prediction has to meet."""

AT_MOST = {
    "resolve_one_of_1000_median_ms": 20.0,
    "solve_1000x2x20_s": 3.0,
    "solve_1000x2x20_gap": 0.01,
    "solve_5000x4x50_s": 60.0,
    "solve_5000x4x50_gap": 0.03,
    "choice_over_best_fixed": 1.15,
    "choice_over_random": 1.0,
    "choice_over_round_robin": 1.0,
    "choice_over_lowest_mean_rtt": 1.0,
}
"""Speed and exactness of the matcher, on two cores; misses of its choice over those of others."""

AT_LEAST = {"histogram_million_records_per_s": 1.0}
"""Speed of what it rests on."""

PARTS = ("calibration", "speed")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `python -m bench matcher`."""
    parser.add_argument("--traces", type=Path, help="folder with index.json and NAME.csv.gz (see docs/benchmarks.md)")
    parser.add_argument("--quick", action="store_true", help="one trace of each family, no fleet of thousands")
    parser.add_argument("--only", choices=PARTS, help="this part alone")
    parser.add_argument(
        "--out", type=Path, default=Path("bench/results"), help="folder for the reports (default %(default)s)"
    )


def run(options: argparse.Namespace) -> int:
    """Measure; returns the exit code: 1 when a target is missed, 2 when the traces are not readable."""
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
    verdicts = _verdicts(findings)
    for name, value in findings.figures.items():
        console.print(f"{name}: {value if value is None or isinstance(value, int) else round(value, 4)}")
    for name, met in verdicts.items():
        console.print(f"{name}: {'met' if met else 'missed'}")
    _write(findings, verdicts, options)
    return 0 if options.quick or all(verdicts.values()) else 1


def _measure(options: argparse.Namespace, say: Callable[[str], None]) -> Findings:
    whole = Findings()
    for part in PARTS:
        if options.only not in (None, part):
            continue
        if part == "calibration":
            findings = calibrated.measure(options.traces, say, quick=options.quick)
        else:
            findings = speed.measure(say, quick=options.quick)
        whole.figures |= findings.figures
        whole.tables += findings.tables
        whole.plots += findings.plots
        whole.notes += findings.notes
    return whole


def _verdicts(findings: Findings) -> dict[str, bool]:
    figures = findings.figures
    verdicts = {} if "calibration_share" not in figures else _calibration_verdicts(figures)
    for name, most in AT_MOST.items():
        value = figures.get(name)
        if value is not None:
            verdicts[f"{name} at most {most:g}"] = value <= most
    for name, least in AT_LEAST.items():
        value = figures.get(name)
        if value is not None:
            verdicts[f"{name} at least {least:g}"] = value >= least
    return verdicts


def _calibration_verdicts(figures: Mapping[str, Figure]) -> dict[str, bool]:
    share = figures["calibration_share"]
    joint, product = (figures[f"calibration_log_error_{kind}"] for kind in ("joint", "product"))
    return {
        f"calibration_share at least {WANTED_SHARE}": share is not None and share >= WANTED_SHARE,
        "joint no worse calibrated than product": joint is not None and product is not None and joint <= product,
    }


def _write(findings: Findings, verdicts: dict[str, bool], options: argparse.Namespace) -> None:
    options.out.mkdir(parents=True, exist_ok=True)
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
