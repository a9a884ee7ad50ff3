"""Two-path traces: a step-wise record of rate, round-trip time and loss of paths `a` and `b`, one clock.

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
from pathlib import Path
from typing import Any

from bench.netlab.errors import LabConfigError
from bench.netlab.profile import DEFAULT_QUEUE_BYTES, LinkProfile

_COLUMNS = (
    "t_s",
    *("a_up_kbps", "a_down_kbps", "a_rtt_ms", "a_loss"),
    *("b_up_kbps", "b_down_kbps", "b_rtt_ms", "b_loss"),
)


@dataclass(frozen=True, slots=True)
class TraceStep:
    """From `at_s` (seconds from the trace's start) on, the link is like this."""

    at_s: float
    up: LinkProfile
    down: LinkProfile

    def to_json(self) -> list[Any]:
        """[at_s, up, down], ready for JSON."""
        return [self.at_s, self.up.to_json(), self.down.to_json()]

    @classmethod
    def from_json(cls, fields: list[Any]) -> TraceStep:
        """The inverse of `to_json`.

        Raises:
            LabConfigError: not such a list.
        """
        try:
            at_s, up, down = fields
            return cls(float(at_s), LinkProfile.from_json(up), LinkProfile.from_json(down))
        except (TypeError, ValueError) as error:
            raise LabConfigError(f"trace step: {error}") from None


@dataclass(frozen=True, slots=True)
class Trace:
    """The steps of each path, in order of time; all paths start at 0 and share one clock."""

    name: str
    paths: dict[str, tuple[TraceStep, ...]]

    @property
    def duration_s(self) -> float:
        """When the last step begins, plus the length of the step before it."""
        times = [step.at_s for step in next(iter(self.paths.values()))]
        return times[-1] + (times[-1] - times[-2] if len(times) > 1 else 1.0)

    def path(self, name: str) -> tuple[TraceStep, ...]:
        """The steps of one path.

        Raises:
            LabConfigError: no such path.
        """
        try:
            return self.paths[name]
        except KeyError:
            raise LabConfigError(f"trace {self.name}: no path {name!r}, only {sorted(self.paths)}") from None


def load_trace(file: str | Path, *, queue_bytes: int = DEFAULT_QUEUE_BYTES) -> Trace:
    """Read a trace file; both paths get a bottleneck queue of `queue_bytes`.

    Raises:
        LabConfigError: unreadable, or not in the format above; names file and line.
    """
    file = Path(file)
    try:
        raw = file.read_bytes()
        if file.suffix == ".gz":
            raw = gzip.decompress(raw)
        text = raw.decode("ascii")
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as error:
        raise LabConfigError(f"trace {file}: {error}") from None
    return parse_trace(text, name=file.name.removesuffix(".gz").removesuffix(".csv"), queue_bytes=queue_bytes)


def parse_trace(text: str, *, name: str = "trace", queue_bytes: int = DEFAULT_QUEUE_BYTES) -> Trace:
    """Parse the text of a trace file.

    Raises:
        LabConfigError: not in the format above; names the line.
    """
    steps: dict[str, list[TraceStep]] = {"a": [], "b": []}
    try:
        reader = csv.DictReader(io.StringIO(text), strict=True, skipinitialspace=True)
        if reader.fieldnames is None or set(reader.fieldnames) != set(_COLUMNS):
            raise LabConfigError(f"trace {name}: expected the columns {', '.join(_COLUMNS)}")
        for row in reader:
            try:
                if None in row or not math.isfinite(float(row["t_s"])):
                    raise ValueError("expected finite numbers, one a column")
                values = {column: float(row[column]) for column in _COLUMNS}
                for path, path_steps in steps.items():
                    path_steps.append(_step(values, path, queue_bytes))
            except (TypeError, ValueError) as error:
                raise LabConfigError(f"trace {name}, line {reader.line_num}: {error}") from None
    except csv.Error as error:
        raise LabConfigError(f"trace {name}: {error}") from None
    times = [step.at_s for step in steps["a"]]
    if not times or times[0] != 0.0 or any(later <= earlier for earlier, later in pairwise(times)):
        raise LabConfigError(f"trace {name}: t_s must start at 0 and grow")
    return Trace(name, {path: tuple(path_steps) for path, path_steps in steps.items()})


def _step(values: dict[str, float], path: str, queue_bytes: int) -> TraceStep:
    def profile(direction: str) -> LinkProfile:
        return LinkProfile(
            delay_ms=values[f"{path}_rtt_ms"] / 2,
            loss=values[f"{path}_loss"],
            rate_kbps=values[f"{path}_{direction}_kbps"],
            queue_bytes=queue_bytes,
        )

    return TraceStep(values["t_s"], profile("up"), profile("down"))
