"""Defines what a section receives and returns."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from bench.reporting.tables import Table

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from bench.dataplane.statistics import Interval, Row
    from bench.reporting.tables import Figure


@dataclass(frozen=True, slots=True)
class Context:
    """How thoroughly to measure, and where."""

    folder: Path
    """Folder for logs; gone after the run."""
    repeats: int
    quick: bool
    say: Callable[[str], None]
    """Shows what is being measured."""

    def scaled(self, count: int, at_least: int = 1) -> int:
        """Return a number of requests, or a fifth of it in a quick run."""
        return max(at_least, count // 5) if self.quick else count


@dataclass(frozen=True, slots=True)
class Plot:
    """Bars (a number for each name), lines or single points (several for each name)."""

    title: str
    x_label: str
    y_label: str
    bars: dict[str, float | None] = field(default_factory=dict)
    lines: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    points: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    log_y: bool = False


@dataclass(slots=True)
class Findings:
    """What a section measured."""

    figures: dict[str, Figure] = field(default_factory=dict)
    intervals: dict[str, Interval | None] = field(default_factory=dict)
    """Intervals of those figures that are estimates, by name."""
    tables: list[Table] = field(default_factory=list)
    plots: list[Plot] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Section:
    """A part of the run."""

    name: str
    title: str
    measure: Callable[[Context], Findings]


def table_of(title: str, rows: Sequence[Row]) -> Table:
    """Return the usual table of runs of requests."""
    columns = ("", "requests", "lost", "P50 ms", "P99 ms", "worst ms")
    return Table(title, columns, tuple((r.name, r.sent, r.lost, r.p50_ms, r.p99_ms, r.max_ms) for r in rows))
