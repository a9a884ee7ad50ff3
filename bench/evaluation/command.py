"""`python -m bench evaluate`: runs scenarios x contenders, records every request, and shows a table; misses first."""

from __future__ import annotations

import fnmatch
import multiprocessing
import sys
import tempfile
import traceback
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from bench.evaluation import drives, ideal, oracle, report_command
from bench.evaluation.contenders import CONTENDERS
from bench.evaluation.ideal import COMPUTED
from bench.evaluation.outcome import figures_by_window
from bench.evaluation.redundancy_costs import mode_costs
from bench.evaluation.report import RUNS, modes_table, read_records, window_table
from bench.evaluation.runner import run as run_in_lab
from bench.evaluation.scenario import Scenario, read_scenarios
from bench.reporting.machine import machine
from bench.reporting.terminal import rich_table
from lab import LabConfigError
from lab.trace_folder import read_folder
from plr.protos.base.errors import ConfigError

if TYPE_CHECKING:
    import argparse

    from bench.evaluation.outcome import Outcome

QUICK_SCENARIO = "drive-1"
QUICK_SECONDS = 15.0
USUAL = (*COMPUTED, *(name for name, contender in CONTENDERS.items() if not contender.ablation))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `python -m bench evaluate`."""
    names = (*CONTENDERS, *COMPUTED)
    parser.add_argument(
        "--scenario", action="append", metavar="GLOB", help="run only these; `python -m bench scenarios` lists them"
    )
    parser.add_argument(
        "--contender",
        action="append",
        choices=names,
        help="run only this one; may be repeated (default: all but plr-1x1 and the like, and those with a budget)",
    )
    parser.add_argument("--traces", type=Path, help="folder of recorded traces; default: only made-up scenarios")
    parser.add_argument("--seconds", type=float, help="shorten every window to this many seconds")
    parser.add_argument("--quick", action="store_true", help=f"run {QUICK_SECONDS:g} s of {QUICK_SCENARIO}")
    parser.add_argument(
        "--out", type=Path, default=Path("bench/results"), help="folder for the reports (default %(default)s)"
    )
    parser.add_argument(
        "--jobs",
        type=_count,
        default=1,
        metavar="N",
        help="runs at once, each in a lab of its own; one takes less than half a core (default %(default)s)",
    )
    parser.add_argument(
        "--resume", action="store_true", help="skip runs that already have a valid record in the folder"
    )
    parser.add_argument(
        "--no-report", action="store_true", help="write only records; `python -m bench report` makes the reports later"
    )
    parser.add_argument("--keep-logs", type=Path, metavar="DIR", help="keep configurations and logs here")


def run(options: argparse.Namespace) -> int:
    """Measure and return the exit code: 1 if a run failed or was disturbed, 2 if something is not readable."""
    try:
        scenarios = _chosen(options)
    except (LabConfigError, ConfigError) as error:
        print(error, file=sys.stderr)
        return 2
    console = Console(highlight=False, soft_wrap=True)
    names = options.contender or USUAL
    failed: list[str] = []
    void = False
    # Processes, not threads: a lab belongs to the process that made it, which waits for its programs.
    with ProcessPoolExecutor(options.jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        try:
            runs = {
                scenario.name: {
                    name: pool.submit(_run, scenario, name, options)
                    for name in names
                    if not (options.resume and _is_done(scenario, name, options.out))
                }
                for scenario in scenarios
            }
            for number, scenario in enumerate(scenarios, 1):
                about = f"{scenario.name} (case {scenario.case}): {scenario.about}, {scenario.duration_s:g} s"
                console.print(f"{number} of {len(scenarios)}: {about}")
                for contender, future in runs[scenario.name].items():
                    about = CONTENDERS[contender].about if contender in CONTENDERS else "computed"
                    with console.status(f"{scenario.name}, {contender}: {about}"):
                        try:
                            outcome = future.result()
                        except LabConfigError:
                            raise
                        except Exception as error:  # the other runs still count
                            traceback.print_exc()
                            failed.append(f"{scenario.name}, {contender}: {error}".splitlines()[0])
                            continue
                    void |= bool(outcome.disturbances)
                    for why in outcome.disturbances:
                        console.print(f"{contender}: void, {why}")
                    for text in outcome.conditions.get("explained", ()):
                        console.print(f"{contender}: {text}")
                of_window = read_records(options.out, scenario.name)
                if of_window:
                    console.print(rich_table(window_table(scenario.name, of_window)))
            outcomes = read_records(options.out)
        except (LabConfigError, ValueError) as error:
            pool.shutdown(wait=False, cancel_futures=True)
            print(error, file=sys.stderr)
            return 2
    costs = mode_costs(figures_by_window(outcomes))
    if costs:
        console.print(rich_table(modes_table(costs)))
    # Drawing comes last, since it would take a processor from the measurement.
    if outcomes and not options.no_report:
        found = drives.find(read_scenarios(read_folder(options.traces))) if options.traces else None
        report_command.write(options.out, outcomes, failed, drives=found)
    for text in failed:
        console.print(f"failed: {text}")
    return 1 if failed or (void and not options.quick) else 0


def _count(text: str) -> int:
    count = int(text)
    if count < 1:
        raise ValueError(text)
    return count


def _chosen(options: argparse.Namespace) -> list[Scenario]:
    scenarios = read_scenarios(read_folder(options.traces) if options.traces else [])
    globs = options.scenario or ([QUICK_SCENARIO] if options.quick else ["*"])
    chosen = [one for one in scenarios if any(fnmatch.fnmatch(one.name, glob) for glob in globs)]
    if not chosen:
        raise LabConfigError(f"no scenario {' or '.join(globs)}; `python -m bench scenarios` lists them")
    seconds = options.seconds or (QUICK_SECONDS if options.quick else None)
    return [one.shortened(seconds) for one in chosen] if seconds else chosen


def _is_done(scenario: Scenario, contender: str, out: Path) -> bool:
    return any(one.contender == contender and not one.disturbances for one in read_records(out, scenario.name))


def _run(scenario: Scenario, contender: str, options: argparse.Namespace) -> Outcome:
    """Run a scenario with a contender and store its record, in a process of the pool."""
    if contender == ideal.ORACLE:
        outcome = oracle.compute(scenario)
    elif contender in COMPUTED:
        outcome = ideal.compute(scenario, contender)
    else:
        outcome = _run_in_lab(scenario, contender, options.keep_logs)
    outcome.conditions["runs_at_once"] = options.jobs
    if contender not in COMPUTED:
        outcome.conditions["machine"] = machine()
    outcome.write(options.out / RUNS)
    return outcome


def _run_in_lab(scenario: Scenario, contender: str, keep_logs: Path | None) -> Outcome:
    with tempfile.TemporaryDirectory(prefix="plr-evaluation-") as name:
        folder = Path(name)
        if keep_logs is not None:
            folder = keep_logs / scenario.name / contender
            folder.mkdir(parents=True, exist_ok=True)
        return run_in_lab(scenario, CONTENDERS[contender], folder)
