"""Finds which recorded windows are one drive: two that replay the same seconds of a recording are not independent.

Each network of a drive was recorded once, and each pair of networks in the car makes a trace. So traces of different
pairs share networks, and windows around the middles of their traces overlap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from bench.evaluation.scenario import Scenario
    from lab import Trace
    from lab.trace_folder import TraceEntry

    Rates = Mapping[str, Sequence[float]]
    """Network -> downlink rate in each step, as recorded; uplink rates are derived from them."""

SAME = 0.5
"""Two windows are one drive if at least this share of them is the same seconds."""
_ALIKE = 1e-3
_VARIED = 3
"""Rates with fewer distinct values than this, such as an outage's zeros, do not show where they come from."""


@dataclass(frozen=True, slots=True)
class Drives:
    """Recorded windows of case A."""

    distinct: tuple[tuple[str, ...], ...]
    """Scenarios grouped by the drive that they replay."""
    recordings: int
    """Number of recordings that they come from; some gave two drives, at different times."""


def find(scenarios: Iterable[Scenario]) -> Drives:
    """Compare the traces of recorded scenarios; raises LabConfigError if one is not readable."""
    windows = {one.name: one.window for one in scenarios if one.case == "A" and one.window is not None}
    of_window = {name: _rates(window.entry, window.load()) for name, window in windows.items()}
    of_trace = {window.entry.name: _rates(window.entry, window.entry.load()) for window in windows.values()}
    steps = min((len(rates) for one in of_window.values() for rates in one.values()), default=0)
    least = max(_VARIED, math.ceil(SAME * steps))
    recordings = together(list(of_trace), lambda one, other: _share(of_trace[one], of_trace[other], least))
    return Drives(
        together(list(of_window), lambda one, other: _share(of_window[one], of_window[other], least)), len(recordings)
    )


def shared_steps(one: Sequence[float], other: Sequence[float], least: int) -> int:
    """Return how many steps agree at the best alignment of the two; 0 if fewer than `least`."""
    found = 0
    for lag in range(least - len(other), len(one) - least + 1):
        begin, end = max(0, lag), min(len(one), lag + len(other))
        if end - begin > found and _same(one[begin:end], other[begin - lag : end - lag]):
            found = end - begin
    return found


def together(names: Sequence[str], alike: Callable[[str, str], bool]) -> tuple[tuple[str, ...], ...]:
    """Group names so that each is alike with another one of its group."""
    groups: list[list[str]] = []
    for name in names:
        near = [group for group in groups if any(alike(name, other) for other in group)]
        groups = [group for group in groups if group not in near]
        groups.append([*(other for group in near for other in group), name])
    return tuple(sorted(tuple(sorted(group)) for group in groups))


def _share(one: Rates, other: Rates, least: int) -> bool:
    return any(shared_steps(one[network], other[network], least) for network in one.keys() & other.keys())


def _same(one: Sequence[float], other: Sequence[float]) -> bool:
    alike = all(math.isclose(mine, yours, rel_tol=_ALIKE) for mine, yours in zip(one, other, strict=True))
    return alike and len(set(one)) >= _VARIED


def _rates(entry: TraceEntry, trace: Trace) -> Rates:
    return {
        network: [step.down.rate_kbps or 0.0 for step in trace.path(name)]
        for name, network in zip(("a", "b"), entry.paths, strict=True)
    }
