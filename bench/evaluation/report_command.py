"""`python -m bench report`: remakes the evaluation's reports from the records of runs; nothing is run."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from bench.evaluation import archive, drives, page, publish, report, summary
from bench.evaluation.drives import Drives
from bench.evaluation.measured import Measured
from bench.evaluation.scenario import read_scenarios
from bench.evaluation.targets import TARGETS
from bench.reporting.terminal import show_verdicts
from lab import LabConfigError
from lab.trace_folder import read_folder

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

    from bench.evaluation.outcome import Outcome

DATA, PAGE, SUMMARY = publish.DATA, "evaluation.html", publish.SUMMARY


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `python -m bench report`."""
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("bench/results"),
        help="folder with the records of `python -m bench evaluate`; the reports go there too (default %(default)s)",
    )
    parser.add_argument(
        "--again",
        type=Path,
        metavar="DIR|FILE",
        help="compare the ratios with another evaluation of the same windows: a folder with its records, or its "
        f"evaluation.json (such as {publish.RESULTS / DATA})",
    )
    parser.add_argument(
        "--traces",
        type=Path,
        metavar="FOLDER",
        help="the recorded traces that were replayed, to find windows of one drive (default: as in the last report)",
    )
    parser.add_argument(
        "--publish",
        type=Path,
        nargs="?",
        const=Path(),
        metavar="CHECKOUT",
        help=f"also write the figures into a checkout's README.md and docs, data and summary into {publish.RESULTS} "
        "(default: the working directory's)",
    )


def run(options: argparse.Namespace) -> int:
    """Write the reports and return the exit code, 2 if there is nothing to report or it is not readable."""
    try:
        outcomes = report.read_records(options.out)
        if not outcomes:
            raise _no_records(options.out)
        again = _again(options.again, options.out) if options.again else None
        failed = _failed_before(options.out / DATA)
        found = drives.find(read_scenarios(read_folder(options.traces))) if options.traces else None
        write(options.out, outcomes, failed, again, options.publish, drives=found)
    except (ValueError, LabConfigError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def write(
    folder: Path,
    outcomes: Sequence[Outcome],
    failed: Sequence[str],
    again: Measured | None = None,
    checkout: Path | None = None,
    *,
    drives: Drives | None = None,
) -> None:
    """Write the reports of at least one run to the folder, and to the checkout if one is given; show the verdicts.

    Raises ValueError if the checkout has no places for the figures.
    """
    whole = report.gather(outcomes, again)
    content = report.as_json(outcomes, failed, again, drives or _drives_before(folder / DATA))
    text = summary.render(whole)
    drawn = {f"{summary.CHARTS}/{chart.name}.svg": chart.svg for section in whole.sections for chart in section.charts}
    (folder / DATA).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    (folder / PAGE).write_text(page.render(whole), encoding="utf-8")
    (folder / SUMMARY).write_text(text, encoding="utf-8")
    charts = folder / summary.CHARTS
    charts.mkdir(exist_ok=True)
    for old in charts.glob("*.svg"):
        old.unlink()
    for name, svg in drawn.items():
        (folder / name).write_bytes(svg)
    console = Console(highlight=False, soft_wrap=True)
    show_verdicts(console, whole.evidence.figures, TARGETS)
    missing = [target.key for target in TARGETS if whole.evidence.figures.get(target.key) is None]
    if missing:
        console.print(f"not measured: {', '.join(missing)}")
    console.print(f"written: {', '.join(str(folder / name) for name in (DATA, PAGE, SUMMARY))}")
    if checkout is not None:
        for one in publish.publish(checkout, content, text, drawn, archive.pack(outcomes, report.RUNS)):
            console.print(f"published: {one.file}: {one.about}")


def _again(path: Path, out: Path) -> Measured:
    """Return the other evaluation; raises ValueError if it is the same one, or there is none."""
    if path.resolve() in (out.resolve(), (out / DATA).resolve()):
        raise ValueError(f"--again {path}: expected another evaluation than --out")
    if path.is_file():
        return Measured.published(path)
    outcomes = report.read_records(path)
    if not outcomes:
        raise _no_records(path)
    return Measured.of(outcomes)


def _no_records(folder: Path) -> ValueError:
    return ValueError(f"{folder / report.RUNS}: no records; `python -m bench evaluate` makes them")


def _failed_before(file: Path) -> list[str]:
    """Return the failed runs that the file names; no record does."""
    return list(_before(file).get("failed", []))


def _drives_before(file: Path) -> Drives | None:
    """Return from the file which windows are one drive; finding out needs the traces."""
    found = _before(file).get("drives")
    if not isinstance(found, dict):
        return None
    try:
        return Drives(tuple(tuple(map(str, names)) for names in found["distinct"]), int(found["recordings"]))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{file}: expected a report, remove it: {error!r}") from None


def _before(file: Path) -> dict[str, Any]:
    if not file.exists():
        return {}
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{file}: expected a report, remove it: {error}") from None
    return content if isinstance(content, dict) else {}
