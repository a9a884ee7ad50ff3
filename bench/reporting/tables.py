"""Formats the tables of text and numbers that every measurement makes."""

from __future__ import annotations

from dataclasses import dataclass

Figure = float | int | None
"""A figure; None if it was not measured, and a note says why."""


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of text or numbers for people."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str | Figure, ...], ...]


def text_of(cell: str | Figure) -> str:
    """Return the text of a cell."""
    if cell is None:
        return "-"
    if isinstance(cell, str | int):
        return str(cell)
    return f"{cell:.0f}" if abs(cell) >= 1000 else f"{cell:.3g}"


def table_as_markdown(table: Table) -> str:
    """Return a table with its title above it."""
    lines = [table.columns, ("---",) * len(table.columns), *(tuple(map(text_of, row)) for row in table.rows)]
    rows = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return f"{table.title}\n\n{rows}\n" if table.title else f"{rows}\n"
