"""Reads a folder of traces: `index.json` lists them, and beside it lies `NAME.csv.gz` for each entry."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from lab.errors import LabConfigError
from lab.traces import Trace, load_trace

DEFAULT_FOLDER = Path(__file__).resolve().parents[2] / "shared" / "traces"
"""Default folder, beside the project's root."""
INDEX = "index.json"
KINDS = ("rate", "rtt")


@dataclass(frozen=True, slots=True)
class TraceEntry:
    """One trace of a folder."""

    name: str
    kind: str
    """`rate` for a trace of capacity; `rtt` for one of pings, which say nothing about capacity."""
    paths: tuple[str, str]
    """The networks that paths a and b use."""
    duration_s: float
    file: Path

    def load(self) -> Trace:
        """Read the trace; raises LabConfigError."""
        return load_trace(self.file)


def read_folder(folder: Path) -> list[TraceEntry]:
    """Return the folder's traces, in order of name; none if it has no index.

    Raises:
        LabConfigError: the index is not readable; the text names the entry.
    """
    index = folder / INDEX
    if not index.is_file():
        return []
    try:
        rows = json.loads(index.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise LabConfigError(f"{index}: {error}") from None
    if not isinstance(rows, list):
        raise LabConfigError(f"{index}: expected a list of traces")
    return sorted((_entry(folder, row, f"{index}[{number}]") for number, row in enumerate(rows)), key=lambda e: e.name)


def _entry(folder: Path, row: object, where: str) -> TraceEntry:
    try:
        if not isinstance(row, dict) or row["kind"] not in KINDS:
            raise ValueError(f"expected an object with kind {' or '.join(KINDS)}")
        name = str(row["name"])
        if Path(name).name != name:
            raise ValueError(f"name {name!r} is no file name")
        paths = (str(row["a"]), str(row["b"]))
        return TraceEntry(name, row["kind"], paths, float(row["duration_s"]), folder / f"{name}.csv.gz")
    except KeyError as error:
        raise LabConfigError(f"{where}: no {error}") from None
    except (TypeError, ValueError) as error:
        raise LabConfigError(f"{where}: {error}") from None
