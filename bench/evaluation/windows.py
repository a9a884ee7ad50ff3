"""Chooses which part of which recorded trace is replayed: by a rule, never by the result.

The rule: traces belong to one family if their names differ only in the number at the end, that is, they have the same
two networks. Of each family's traces that are long enough, in order of name, a number of evenly spaced ones is chosen,
beginning with the first; and of each trace the part around its middle. Round-trip traces (`rtt`) do not show capacity
and are left out.
"""

from __future__ import annotations

import fnmatch
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from lab import Trace, TraceStep

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lab.trace_folder import TraceEntry


@dataclass(frozen=True, slots=True)
class Window:
    """A part of a recorded trace."""

    entry: TraceEntry
    start_s: float
    length_s: float

    @property
    def name(self) -> str:
        """The trace's name and the second at which the window begins."""
        return f"{self.entry.name}-at-{self.start_s:g}"

    def middle(self, length_s: float) -> Window:
        """Return a shorter window around the middle of this one."""
        return replace(self, start_s=self.start_s + (self.length_s - length_s) / 2, length_s=length_s)

    def load(self) -> Trace:
        """Read its trace; both paths share a clock that starts with the window. Raises LabConfigError."""
        return cut(self.entry.load(), self.start_s, self.length_s)


def choose(traces: Sequence[TraceEntry], names: str, of_each_family: int, length_s: float) -> list[Window]:
    """Return the windows that the rule above gives for traces whose name matches the glob."""
    families: dict[str, list[TraceEntry]] = {}
    for entry in sorted(traces, key=lambda one: one.name):
        if entry.kind == "rate" and entry.duration_s >= length_s and fnmatch.fnmatch(entry.name, names):
            families.setdefault(entry.name.rstrip("0123456789"), []).append(entry)
    return [
        Window(entry, float((entry.duration_s - length_s) // 2), length_s)
        for family in families.values()
        for entry in _spread(family, of_each_family)
    ]


def _spread(family: Sequence[TraceEntry], count: int) -> Sequence[TraceEntry]:
    return [family[number * len(family) // count] for number in range(count)] if count < len(family) else family


def cut(trace: Trace, start_s: float, length_s: float) -> Trace:
    """Return the part of a trace from `start_s` on; its last step stays in force after the window."""
    paths = {}
    for name, steps in trace.paths.items():
        before = [step for step in steps if step.at_s <= start_s]
        inside = [step for step in steps if start_s < step.at_s < start_s + length_s]
        first = before[-1:] or steps[:1]
        paths[name] = tuple(TraceStep(max(0.0, step.at_s - start_s), step.up, step.down) for step in (*first, *inside))
    return Trace(f"{trace.name}-at-{start_s:g}", paths)
