"""Chooses the recorded windows, and says which may be tuned on and which judge (written before any run).

The rule: traces that share a recorded network's series belong to one recording. Each trace of a recording gives one
window of WINDOW_S: of K traces, in order of name, number k (from 0) gives the one whose start lies at (k + 1/2) / K of
the room that its length leaves. So a recording's windows lie at different times of it, over different pairs of its
networks. A window of which half is also in an earlier one is left out. Recordings are sorted by the name of their first
trace; those at even places (0, 2, ...) may be tuned on, those at odd places judge.
"""

from __future__ import annotations

import enum
import fnmatch
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from bench.evaluation.drives import SAME, shared_steps, together
from bench.evaluation.scenario import Scenario
from bench.evaluation.windows import Window

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from bench.evaluation.scenario import Traffic
    from lab import Trace
    from lab.trace_folder import TraceEntry

WINDOW_S = 120.0
NAMES = "drive-*"
RUN_STEPS = 30
"""Consecutive seconds that agree only if they are the same seconds of one recording ..."""
RUNS = 3
"""... when found at this many of the places looked at ..."""
LOOK_EVERY = 10
"""... which are this many steps apart."""
_VARIED = 3
"""Fewer distinct rates than this, such as an outage's zeros, do not show where they come from."""


class Half(enum.StrEnum):
    """What a recording may be used for."""

    TUNED = "tuned"
    JUDGED = "judged"


@dataclass(frozen=True, slots=True)
class DriveWindow:
    """One window: its scenario, the recording that it is of, and the half that this belongs to."""

    scenario: Scenario
    recording: str
    half: Half


def windows(traces: Sequence[TraceEntry], traffic: Traffic, length_s: float = WINDOW_S) -> list[DriveWindow]:
    """Return the windows that the rule gives; raises LabConfigError if a trace is not readable."""
    entries = {
        entry.name: entry
        for entry in traces
        if entry.kind == "rate" and entry.duration_s >= length_s and fnmatch.fnmatch(entry.name, NAMES)
    }
    rates = {name: _rates(entry, entry.load()) for name, entry in entries.items()}
    recordings = together(list(rates), lambda one, other: _same_recording(rates[one], rates[other]))
    return [
        DriveWindow(scenario, recording[0], (Half.TUNED, Half.JUDGED)[place % 2])
        for place, recording in enumerate(recordings)
        for scenario in _of_recording([entries[name] for name in recording], traffic, length_s)
    ]


def _of_recording(entries: Sequence[TraceEntry], traffic: Traffic, length_s: float) -> Iterator[Scenario]:
    kept: list[dict[str, list[float]]] = []
    for place, entry in enumerate(entries):
        window = Window(entry, math.floor((place + 0.5) / len(entries) * (entry.duration_s - length_s)), length_s)
        rates = _rates(entry, window.load())
        least = math.ceil(SAME * len(next(iter(rates.values()))))
        if not any(_overlap(rates, other, least) for other in kept):
            kept.append(rates)
            yield Scenario(window.name, "A", "recorded drive", length_s, traffic, window=window)


def _overlap(one: dict[str, list[float]], other: dict[str, list[float]], least: int) -> bool:
    return any(shared_steps(one[network], other[network], least) for network in one.keys() & other.keys())


def _same_recording(one: dict[str, list[float]], other: dict[str, list[float]]) -> bool:
    return any(_shared_runs(one[network], other[network]) >= RUNS for network in one.keys() & other.keys())


def _shared_runs(one: Sequence[float], other: Sequence[float]) -> int:
    """Return at how many of the places looked at in `one` the next RUN_STEPS rates occur in `other` as well."""
    known = {_run(other, place) for place in range(len(other) - RUN_STEPS + 1)}
    looked_at = (_run(one, place) for place in range(0, len(one) - RUN_STEPS + 1, LOOK_EVERY))
    return sum(len(set(run)) >= _VARIED and run in known for run in looked_at)


def _run(rates: Sequence[float], place: int) -> tuple[float, ...]:
    return tuple(round(rate, 3) for rate in rates[place : place + RUN_STEPS])


def _rates(entry: TraceEntry, trace: Trace) -> dict[str, list[float]]:
    return {
        network: [step.down.rate_kbps or 0.0 for step in trace.path(name)]
        for name, network in zip(("a", "b"), entry.paths, strict=True)
    }


def with_traffic(window: DriveWindow, traffic: Traffic) -> DriveWindow:
    """Return the same window under another load."""
    return replace(window, scenario=replace(window.scenario, traffic=traffic))
