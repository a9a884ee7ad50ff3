"""`plr plan`: predicts from recordings, without a network, how many interfaces and servers meet a target."""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plr.controlplane.planning import plan_text
from plr.controlplane.planning.plot import PlotError, draw
from plr.controlplane.planning.prospects import least_set
from plr.controlplane.planning.traces import TraceError, read_trace
from plr.controlplane.planning.workload import DEFAULT, Compute, Workload
from plr.protos.base.printable import escaped
from plr.protos.program import extras
from plr.protos.program.arguments import whole
from plr.protos.program.exit_codes import EXIT_NO, EXIT_OK, EXIT_USAGE

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from plr.controlplane.planning.prospects import Source
    from plr.controlplane.planning.traces import RecordedPaths
    from plr.protos.program.arguments import Commands


MAX_REPLAYED_REQUESTS = 5_000_000
"""Most requests sent through traces in one run: some minutes."""

MAX_REQUEST_OR_ANSWER_BYTES = 1 << 24

_EPILOG = """\
The LSC theorem says that one server behind one path cannot be latency-reliable on commodity infrastructure: it misses
with some epsilon > 0. Copies over k independent paths all miss with epsilon^k, so some k meets any target. This command
says which: PRODUCT is what independent paths would give, JOINT what was recorded. Each interface goes to one server.

examples:
  plr explain --tls-dir ~/.plr/alice --json robot-7 /plan > robot-7.json
  plr plan --recorded robot-7.json --target 0.001
  plr plan --traces drive-*.csv.gz --request-bytes 120000 --rate-hz 5 --deadline-ms 250 --target 0.01 --plot plan.svg

exit codes: 0 done (with --target: some set meets it), 1 no set meets the target, 2 bad usage
"""


class _UsageError(Exception):
    """The command cannot be carried out; the text is one line for the user."""


def add_to(commands: Commands, summary: str) -> None:
    """Add the command to `plr`."""
    plan = commands.add_parser(
        "plan",
        help=summary,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    source = plan.add_mutually_exclusive_group(required=True)
    source.add_argument("--recorded", type=Path, metavar="FILE", help="what plr explain --json printed")
    source.add_argument(
        "--traces",
        type=Path,
        nargs="+",
        metavar="FILE|DIR",
        help="traces of two paths, .csv or .csv.gz, or folders",
    )
    plan.add_argument("--deadline-ms", type=_number(0.0), metavar="MS", help="with --recorded: the service's own")
    plan.add_argument(
        "--target", type=_number(0.0, 1.0), metavar="PROBABILITY", help="highest acceptable probability to miss"
    )
    plan.add_argument(
        "--plot", type=Path, metavar="FILE", help="plot the probability over the deadline into this .svg or .html file"
    )
    plan.add_argument("--json", action="store_true", help="print the table as JSON")
    workload = plan.add_argument_group("requests that are sent through traces")
    size = whole(1, MAX_REQUEST_OR_ANSWER_BYTES)
    workload.add_argument("--request-bytes", type=size, metavar="N", help=f"the default is {DEFAULT.request_bytes}")
    workload.add_argument("--answer-bytes", type=size, metavar="N", help=f"the default is {DEFAULT.answer_bytes}")
    workload.add_argument(
        "--rate-hz", type=_number(0.0), metavar="N", help=f"requests a second; the default is {DEFAULT.rate_hz:g}"
    )
    workload.add_argument(
        "--compute-ms",
        type=_compute,
        dest="compute",
        metavar="MEDIAN:P99",
        help="how long servers take, log-normal; the default is 20:40",
    )
    plan.set_defaults(run=_plan)


def _number(above: float, below: float = float("inf")) -> Callable[[str], float]:
    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = above
        if not above < value < below:
            limit = f" and below {below:g}" if below < float("inf") else ""
            raise argparse.ArgumentTypeError(f"expected a number above {above:g}{limit}, got {text!r}")
        return value

    return parse


def _compute(text: str) -> Compute:
    median, _, p99 = text.partition(":")
    try:
        found = Compute(float(median) / 1e3, float(p99) / 1e3)
    except ValueError:
        found = Compute(0.0, 0.0)
    if not 0.0 < found.median_s <= found.p99_s < float("inf"):
        raise argparse.ArgumentTypeError(f"expected MEDIAN:P99 in milliseconds, such as 20:40, got {text!r}")
    return found


def _given(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the workload options that were given."""
    keys = (field.name for field in fields(Workload))
    return {key: getattr(arguments, key) for key in keys if getattr(arguments, key) is not None}


def _plan(arguments: argparse.Namespace) -> int:
    lacking = extras.missing("controlplane", extras.PLAN)
    if lacking is not None:
        sys.stderr.write(f"plr plan: {lacking}\n")
        return EXIT_USAGE
    # This imports numpy, which an operator who only queries does not need.
    from plr.controlplane.planning.recorded import RecordingError

    try:
        source, deadline_s = _recorded(arguments) if arguments.recorded is not None else _replayed(arguments)
        prospects = source.prospects(deadline_s)
        if not prospects:
            raise _UsageError(f"{arguments.recorded}: no pair in it carried a request or a probe")
        if arguments.plot is not None:
            draw(arguments.plot, source, deadline_s, arguments.target)
    except (_UsageError, RecordingError, TraceError, PlotError) as error:
        sys.stderr.write(escaped(f"plr: {error}") + "\n")
        return EXIT_USAGE
    least = least_set(prospects, arguments.target) if arguments.target is not None else None
    if arguments.json:
        told = {
            "recorded": source.title,
            "deadline_ms": deadline_s * 1e3,
            "target": arguments.target,
            "sets": [asdict(found) for found in prospects],
            "least": asdict(least) if least is not None else None,
        }
        sys.stdout.write(json.dumps(told, indent=2) + "\n")
    else:
        sys.stdout.write(plan_text.render(source, prospects, deadline_s, arguments.target) + "\n")
    return EXIT_NO if arguments.target is not None and least is None else EXIT_OK


def _recorded(arguments: argparse.Namespace) -> tuple[Source, float]:
    from plr.controlplane.planning.recorded import RecordedService, read_recording

    if _given(arguments):
        raise _UsageError("sizes, rate and computing times need --traces: a recording has its own")
    source = RecordedService(read_recording(arguments.recorded))
    deadline_ms = arguments.deadline_ms
    return source, source.deadline_s if deadline_ms is None else deadline_ms / 1e3


def _replayed(arguments: argparse.Namespace) -> tuple[Source, float]:
    from plr.controlplane.planning.replay import ReplayedTraces

    if arguments.deadline_ms is None:
        raise _UsageError("--traces needs --deadline-ms")
    workload = replace(DEFAULT, **_given(arguments))
    traces = _read(arguments.traces)
    requests = sum(trace.duration_s for trace in traces) * workload.rate_hz
    if requests > MAX_REPLAYED_REQUESTS:
        raise _UsageError(
            f"{requests:.0f} requests, {MAX_REPLAYED_REQUESTS} at most: give fewer traces or a lower --rate-hz"
        )
    if requests < 1.0:
        raise _UsageError("the traces are too short for a single request")
    return ReplayedTraces(traces, workload), arguments.deadline_ms / 1e3


def _read(paths: Sequence[Path]) -> list[RecordedPaths]:
    files: list[Path] = []
    for path in paths:
        inside = _inside(path)
        if not inside:
            raise _UsageError(f"{path}: no .csv or .csv.gz in this folder")
        files += inside
    return [read_trace(file) for file in files]


def _inside(path: Path) -> list[Path]:
    """Return the traces in a folder; for any other path, the path itself."""
    try:
        names = sorted(os.listdir(path))
    except NotADirectoryError:
        return [path]
    except (OSError, ValueError) as error:
        # A name that contains a NUL, or is too long, is never looked up in the file system.
        raise _UsageError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    return [path / name for name in names if name.endswith((".csv", ".csv.gz"))]
