"""`python -m bench report`: the evaluation's reports anew from the records of runs; nothing is run."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from bench.evaluation import page, report, summary
from bench.evaluation.targets import TARGETS
from bench.reporting.terminal import show_verdicts

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping, Sequence

    from bench.evaluation.outcome import Outcome

DATA, PAGE, SUMMARY = "evaluation.json", "evaluation.html", "evaluation.md"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `python -m bench report`."""
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("bench/results"),
        help="folder with the records of `python -m bench evaluate`; the reports go there too (default %(default)s)",
    )


def run(options: argparse.Namespace) -> int:
    """Write the reports; returns the exit code, 2 when there is nothing to report or it is not readable."""
    try:
        outcomes = report.read_records(options.out)
        before = _before(options.out / DATA)
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    if not outcomes:
        print(f"{options.out / report.RUNS}: no records; `python -m bench evaluate` makes them", file=sys.stderr)
        return 2
    write(options.out, outcomes, before.get("machine", {}), before.get("failed", []))
    return 0


def write(folder: Path, outcomes: Sequence[Outcome], machine: Mapping[str, Any], failed: Sequence[str]) -> None:
    """Write the reports of at least one run to the folder, and show the verdicts."""
    whole = report.gather(outcomes, machine)
    content = report.as_json(outcomes, machine, failed)
    (folder / DATA).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    (folder / PAGE).write_text(page.render(whole), encoding="utf-8")
    (folder / SUMMARY).write_text(summary.render(whole), encoding="utf-8")
    charts = folder / summary.CHARTS
    charts.mkdir(exist_ok=True)
    for old in charts.glob("*.svg"):
        old.unlink()
    for section in whole.sections:
        for chart in section.charts:
            (charts / f"{chart.name}.svg").write_bytes(chart.svg)
    console = Console(highlight=False, soft_wrap=True)
    show_verdicts(console, whole.evidence.figures, TARGETS)
    console.print(f"written: {', '.join(str(folder / name) for name in (DATA, PAGE, SUMMARY))}")


def _before(file: Path) -> dict[str, Any]:
    """What the file says of the machine and of runs that failed, which no record does."""
    if not file.exists():
        return {}
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{file}: expected a report, remove it: {error}") from None
    return content if isinstance(content, dict) else {}
