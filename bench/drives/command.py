"""`python -m bench drives`: runs contenders over recorded windows in simulated time, and judges ours."""

from __future__ import annotations

import fnmatch
import json
import os
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import Progress

from bench.drives.contenders import COMPUTED, CONTENDERS, FIFO_ALONE
from bench.drives.contenders import run as run_one
from bench.drives.targets import TARGETS, figures
from bench.drives.windows import NAMES, Half, windows
from bench.evaluation.outcome import Figures, together
from bench.evaluation.scenario import Traffic
from bench.reporting.machine import machine
from bench.reporting.tables import Table
from bench.reporting.terminal import rich_table, show_verdicts
from lab.errors import LabConfigError
from lab.trace_folder import DEFAULT_FOLDER, read_folder

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterable, Mapping, Sequence

    from bench.drives.windows import DriveWindow
    from bench.evaluation.outcome import Outcome

    Runs = dict[str, dict[str, Outcome]]

OURS = "plr-adaptive"
"""The mode that is judged."""
DEFAULT = (*COMPUTED, "plr-single", "plr-replicate", OURS)
TRAFFIC = Traffic(request_bytes=120_000, answer_bytes=1_000, rate_hz=5, deadline_ms=1_000, compute_ms=20)
FILE_COLUMNS = 200
"""Width of the tables where no terminal says one."""
REPLICATE = "plr-replicate"
BEFORE_FILE = Path(__file__).with_name("before.json")
"""Figures of `plr-replicate` before this bench judged anything, by window: written once, by --write-before."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `python -m bench drives`."""
    parser.add_argument(
        "--traces", type=Path, default=DEFAULT_FOLDER, help="folder with index.json (default %(default)s)"
    )
    parser.add_argument("--half", choices=[*Half], default=Half.JUDGED, help="windows to run (default %(default)s)")
    parser.add_argument("--window", metavar="GLOB", default="*", help="only windows of this name")
    parser.add_argument(
        "--contender", action="append", choices=CONTENDERS, metavar="NAME", help=f"one of {', '.join(CONTENDERS)}"
    )
    parser.add_argument("--ours", choices=CONTENDERS, default=OURS, help="what is judged (default %(default)s)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes (default %(default)s)")
    parser.add_argument(
        "--out", type=Path, default=Path("bench/results"), help="folder for drives.json (default %(default)s)"
    )
    parser.add_argument("--alone", action="store_true", help="compare each path by itself with FIFO")
    parser.add_argument("--write-before", action="store_true", help=f"keep {REPLICATE}'s figures as those of before")
    for name in ("rate_hz", "request_bytes", "deadline_ms"):
        parser.add_argument(f"--{name.replace('_', '-')}", type=float, help=f"{name} in place of the usual one")


def run(options: argparse.Namespace) -> int:
    """Run, show tables and return the exit code: 1 if a target is missed, 2 if there is nothing to run."""
    console = Console(highlight=False, soft_wrap=True)
    if not console.is_terminal:
        console.width = FILE_COLUMNS
    traffic = _traffic(options)
    try:
        found = windows(read_folder(options.traces), traffic)
    except LabConfigError as error:
        console.print(str(error))
        return 2
    chosen = [one for one in found if one.half == options.half and fnmatch.fnmatch(one.scenario.name, options.window)]
    if not chosen:
        console.print(f"no window: --traces has to name a folder with traces called {NAMES}")
        return 2
    usual = [*DEFAULT, options.ours]
    if options.alone:
        usual = [name for path, fifo in FIFO_ALONE.items() for name in (fifo, f"{options.ours}-{path}")]
    contenders = tuple(dict.fromkeys(options.contender or usual))
    runs = _run_all(chosen, contenders, options.jobs, console)
    before = _before() if traffic == TRAFFIC else {}
    if options.write_before:
        before |= {name: of[REPLICATE].figures() for name, of in runs.items() if REPLICATE in of}
        kept = {name: asdict(one) for name, one in sorted(before.items())}
        BEFORE_FILE.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    console.print(rich_table(_totals(runs)))
    console.print(rich_table(_by_window(chosen, runs)))
    judged = figures(runs, options.ours, before)
    show_verdicts(console, judged, TARGETS)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "drives.json").write_text(json.dumps(_record(judged, runs, options), indent=1) + "\n")
    console.print(f"figures: {options.out / 'drives.json'}")
    return 1 if any(target.met(judged) is False for target in TARGETS) else 0


def _traffic(options: argparse.Namespace) -> Traffic:
    changes = {name: getattr(options, name) for name in ("rate_hz", "request_bytes", "deadline_ms")}
    given = {name: value for name, value in changes.items() if value is not None}
    if "request_bytes" in given:
        given["request_bytes"] = int(given["request_bytes"])
    return TRAFFIC.model_copy(update=given)


def _run_all(chosen: Sequence[DriveWindow], contenders: Iterable[str], jobs: int, console: Console) -> Runs:
    runs: Runs = {window.scenario.name: {} for window in chosen}
    with ProcessPoolExecutor(jobs) as pool, Progress(console=console, transient=True) as progress:
        waiting = {
            pool.submit(run_one, window.scenario, contender): (window.scenario.name, contender)
            for window in chosen
            for contender in contenders
        }
        bar = progress.add_task("drives", total=len(waiting))
        for done in as_completed(waiting):
            name, contender = waiting[done]
            runs[name][contender] = done.result()
            progress.update(bar, advance=1, description=f"{name} {contender}")
    return runs


def _before() -> dict[str, Figures]:
    if not BEFORE_FILE.is_file():
        return {}
    return {name: Figures(**fields) for name, fields in json.loads(BEFORE_FILE.read_text(encoding="utf-8")).items()}


def _totals(runs: Runs) -> Table:
    names = dict.fromkeys(name for of in runs.values() for name in of)
    rows = []
    for name in names:
        whole = together([of[name] for of in runs.values() if name in of]).figures()
        size = None if whole.bytes_per_request is None else whole.bytes_per_request / 1e3
        unanswered = round(whole.unanswered_ratio * whole.requests)
        rows.append(
            (name, whole.requests, round(whole.misses), unanswered, whole.mean_ms, whole.p50_ms, whole.p99_ms, size)
        )
    columns = ("contender", "requests", "missed", "unanswered", "mean, ms", "P50, ms", "P99, ms", "kB sent")
    return Table("all windows", columns, tuple(rows))


def _by_window(chosen: Sequence[DriveWindow], runs: Mapping[str, Mapping[str, Outcome]]) -> Table:
    names = tuple(dict.fromkeys(name for of in runs.values() for name in of))
    rows = []
    for window in chosen:
        of = {name: one.figures() for name, one in runs[window.scenario.name].items()}
        cells = (f"{round(of[name].misses)} / {of[name].mean_ms:.0f}" if name in of else None for name in names)
        rows.append((window.scenario.name, *cells))
    return Table("missed / mean in ms, by window", ("window", *names), tuple(rows))


def _record(
    judged: Mapping[str, float], runs: Mapping[str, Mapping[str, Outcome]], options: argparse.Namespace
) -> dict[str, object]:
    return {
        **judged,
        "verdicts": {target.key: target.met(judged) for target in TARGETS},
        "half": options.half,
        "ours": options.ours,
        "windows": {name: {who: asdict(one.figures()) for who, one in of.items()} for name, of in runs.items()},
        "machine": machine(),
    }
