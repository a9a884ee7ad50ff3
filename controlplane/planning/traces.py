"""Reads two-path traces: step-wise records of rate, round-trip time and loss of paths `a` and `b` on one clock.

A trace file is CSV, gzip-compressed if its name ends in .gz, with a header and one row per step:

    t_s, a_up_kbps, a_down_kbps, a_rtt_ms, a_loss, b_up_kbps, b_down_kbps, b_rtt_ms, b_loss

A row holds from its `t_s` to the next. Rate 0 is an outage. Each direction gets half the round-trip time.
"""

from __future__ import annotations

import csv
import gzip
import io
import math
import zlib
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

from plr.protos.program.regular_file import read_regular

if TYPE_CHECKING:
    from pathlib import Path

COLUMNS = (
    "t_s",
    *("a_up_kbps", "a_down_kbps", "a_rtt_ms", "a_loss"),
    *("b_up_kbps", "b_down_kbps", "b_rtt_ms", "b_loss"),
)
PATHS = ("a", "b")

MAX_TRACE_BYTES = 64 << 20
"""Longest trace, unpacked: a day of steps 0.1 s apart."""

DEFAULT_QUEUE_BYTES = 1_200_000
"""What a cellular base station or a Wi-Fi driver commonly buffers for one station."""


class TraceError(ValueError):
    """The text is not a trace; the message names file or trace, and the line."""


@dataclass(frozen=True, slots=True)
class Direction:
    """One direction of a path. Packets are lost with probability `loss`. The others leave a first-in-first-out queue of
    `queue_bytes` at `rate_kbps` (kilobit/s of IP packets), and arrive after `delay_ms` of propagation."""

    rate_kbps: float
    delay_ms: float
    loss: float
    queue_bytes: int = DEFAULT_QUEUE_BYTES


@dataclass(frozen=True, slots=True)
class PathStep:
    """The state of the path from `at_s` on, in seconds from the trace's start."""

    at_s: float
    up: Direction
    down: Direction


@dataclass(frozen=True, slots=True)
class RecordedPaths:
    """The steps of each path, in order of time; all paths start at 0 and share one clock."""

    name: str
    paths: dict[str, tuple[PathStep, ...]]

    @property
    def duration_s(self) -> float:
        """Start of the last step, plus the length of the step before it."""
        times = [step.at_s for step in next(iter(self.paths.values()))]
        return times[-1] + (times[-1] - times[-2] if len(times) > 1 else 1.0)


def read_trace(file: Path, *, queue_bytes: int = DEFAULT_QUEUE_BYTES) -> RecordedPaths:
    """Read a trace file; both paths get a queue of `queue_bytes`.

    Raises:
        TraceError: unreadable, or not in the format above.
    """
    try:
        raw = read_regular(file, MAX_TRACE_BYTES + 1)
        if file.suffix == ".gz":
            with gzip.open(io.BytesIO(raw)) as unpacked:
                raw = unpacked.read(MAX_TRACE_BYTES + 1)
        text = raw.decode("ascii")
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as error:
        raise TraceError(f"trace {file}: {getattr(error, 'strerror', None) or error}") from None
    if len(raw) > MAX_TRACE_BYTES:
        raise TraceError(f"trace {file}: expected at most {MAX_TRACE_BYTES} bytes")
    return parse_trace(text, name=file.name.removesuffix(".gz").removesuffix(".csv"), queue_bytes=queue_bytes)


def parse_trace(text: str, *, name: str = "trace", queue_bytes: int = DEFAULT_QUEUE_BYTES) -> RecordedPaths:
    """Parse the text of a trace file.

    Raises:
        TraceError: not in the format above.
    """
    steps: dict[str, list[PathStep]] = {path: [] for path in PATHS}
    try:
        reader = csv.DictReader(io.StringIO(text), strict=True, skipinitialspace=True)
        if reader.fieldnames is None or set(reader.fieldnames) != set(COLUMNS):
            raise TraceError(f"trace {name}: expected the columns {', '.join(COLUMNS)}")
        for row in reader:
            try:
                values = _numbers(row)
                for path, path_steps in steps.items():
                    path_steps.append(_step(values, path, queue_bytes))
            except ValueError as error:
                raise TraceError(f"trace {name}, line {reader.line_num}: {error}") from None
    except csv.Error as error:
        raise TraceError(f"trace {name}: {error}") from None
    times = [step.at_s for step in steps[PATHS[0]]]
    if not times or times[0] != 0.0 or any(later <= earlier for earlier, later in pairwise(times)):
        raise TraceError(f"trace {name}: t_s must start at 0 and grow")
    return RecordedPaths(name, {path: tuple(path_steps) for path, path_steps in steps.items()})


def _numbers(row: dict[str, str]) -> dict[str, float]:
    """Check one row and return its numbers. Rates and times are not negative, losses are probabilities."""
    # The reader puts surplus fields under the key None, and None where a field is missing.
    if set(row) != set(COLUMNS) or None in row.values():
        raise ValueError(f"expected {len(COLUMNS)} numbers")
    values = {column: float(row[column]) for column in COLUMNS}
    for column, value in values.items():
        if not (math.isfinite(value) and value >= 0.0):
            raise ValueError(f"{column}: expected a finite number >= 0, got {value!r}")
        if column.endswith("_loss") and value > 1.0:
            raise ValueError(f"{column}: expected a probability 0..1, got {value!r}")
    return values


def _step(values: dict[str, float], path: str, queue_bytes: int) -> PathStep:
    def direction(name: str) -> Direction:
        return Direction(
            rate_kbps=values[f"{path}_{name}_kbps"],
            delay_ms=values[f"{path}_rtt_ms"] / 2,
            loss=values[f"{path}_loss"],
            queue_bytes=queue_bytes,
        )

    return PathStep(values["t_s"], direction("up"), direction("down"))
