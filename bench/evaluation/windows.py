"""Which stretch of which recorded trace is replayed: chosen by a rule, never by what comes out.

The rule. Traces belong to one family when their names differ in the number at the end only: the same two networks. Of
each family, in order of name, come so many at even distances, beginning with the first, of those that are long enough;
and of each trace the stretch around its middle. Round-trip traces (`rtt`) know nothing of capacity and are left out.
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
    """A stretch of a recorded trace."""

    entry: TraceEntry
    start_s: float
    length_s: float

    @property
    def name(self) -> str:
        """The trace's name and the second at which the window begins."""
        return f"{self.entry.name}-at-{self.start_s:g}"

    def middle(self, length_s: float) -> Window:
        """A shorter window around the middle of this one."""
        return replace(self, start_s=self.start_s + (self.length_s - length_s) / 2, length_s=length_s)

    def load(self) -> Trace:
        """Its trace; the clock begins with the window, both paths stay on it. Raises LabConfigError."""
        return cut(self.entry.load(), self.start_s, self.length_s)


def choose(traces: Sequence[TraceEntry], names: str, of_each_family: int, length_s: float) -> list[Window]:
    """The windows that the rule above gives for traces whose name matches the glob."""
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
    """The stretch of a trace from `start_s` on. Its last step stays in force when the window is over."""
    paths = {}
    for name, steps in trace.paths.items():
        before = [step for step in steps if step.at_s <= start_s]
        inside = [step for step in steps if start_s < step.at_s < start_s + length_s]
        first = before[-1:] or steps[:1]
        paths[name] = tuple(TraceStep(max(0.0, step.at_s - start_s), step.up, step.down) for step in (*first, *inside))
    return Trace(f"{trace.name}-at-{start_s:g}", paths)
