"""Finds the traces to replay: recorded ones, or generated ones in their place."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bench.evaluation.generator import generate
from lab.trace_folder import DEFAULT_FOLDER, INDEX, read_folder

if TYPE_CHECKING:
    from pathlib import Path

    from lab.traces import Trace

MADE_UP = 6
MADE_UP_S = 600.0


def load(folder: Path | None) -> tuple[list[tuple[Trace, str]], str]:
    """Return traces with their kinds (`rate` or `rtt`), and a note if generated ones replace recorded ones.

    Raises:
        LabConfigError: a trace is not readable.
    """
    folder = folder or DEFAULT_FOLDER
    entries = read_folder(folder)
    if not entries:
        note = f"no {folder / INDEX}: {MADE_UP} made-up drives instead"
        return [(generate("drive", seed, MADE_UP_S), "rate") for seed in range(MADE_UP)], note
    return [(entry.load(), entry.kind) for entry in entries], ""
