"""Which traces there are to replay: recorded ones, or random ones in their place."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING

from bench.netlab.profile import LinkProfile
from bench.netlab.trace_folder import DEFAULT_FOLDER, INDEX, read_folder
from bench.netlab.traces import Trace, TraceStep

if TYPE_CHECKING:
    from pathlib import Path

SYNTHETIC = 6
SYNTHETIC_STEPS = 600


def load(folder: Path | None) -> tuple[list[tuple[Trace, str]], str]:
    """Traces with their kinds (`rate` or `rtt`), and a note where random ones stand in for recorded ones.

    Raises:
        LabConfigError: a trace is not readable.
    """
    folder = folder or DEFAULT_FOLDER
    entries = read_folder(folder)
    if not entries:
        note = f"no {folder / INDEX}: {SYNTHETIC} random traces instead, whose figures say little of real networks"
        return [(synthetic(number), "rate") for number in range(SYNTHETIC)], note
    return [(entry.load(), entry.kind) for entry in entries], ""


def synthetic(seed: int) -> Trace:
    """Two paths whose rates wander and go out now and then, sometimes together."""
    rng = random.Random(seed)
    paths: dict[str, list[TraceStep]] = {"a": [], "b": []}
    rates = {"a": 3e4, "b": 2e4}
    out = {"a": 0, "b": 0}
    for second in range(SYNTHETIC_STEPS):
        together = rng.random() < 0.005
        for name, steps in paths.items():
            rates[name] = min(1e5, max(2e3, rates[name] * rng.lognormvariate(0.0, 0.3)))
            out[name] = max(0, out[name] - 1)
            if together or rng.random() < 0.01:
                out[name] = rng.randrange(1, 10)
            rate = 0.0 if out[name] else rates[name]
            profile = LinkProfile(delay_ms=25.0, rate_kbps=rate, loss=0.001)
            steps.append(TraceStep(float(second), profile, profile))
    return Trace(f"random-{seed}", {name: tuple(steps) for name, steps in paths.items()})
