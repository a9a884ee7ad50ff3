"""Shows tables and verdicts on the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rich.table import Table as RichTable

from bench.reporting.tables import text_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rich.console import Console

    from bench.reporting.tables import Figure, Table
    from bench.reporting.targets import Target


def rich_table(table: Table) -> RichTable:
    """Return a table for the terminal."""
    shown = RichTable(title=table.title, title_justify="left")
    for column in table.columns:
        shown.add_column(column, justify="right" if column else "left")
    for row in table.rows:
        shown.add_row(*(text_of(cell) for cell in row))
    return shown


def show_verdicts(
    console: Console,
    figures: Mapping[str, Figure],
    targets: Sequence[Target],
    notes: Mapping[str, str] | None = None,
) -> None:
    """Show which targets are met and missed; `notes` explain figures, by name."""
    table = RichTable(title="targets", title_justify="left")
    for column in ("figure", "value", "wanted", "verdict", *(("from",) if notes is not None else ())):
        shape: dict[str, Any] = {"no_wrap": column in ("value", "verdict")}
        if column == "value":
            shape["justify"] = "right"
        elif column == "figure":
            shape["overflow"] = "fold"
        table.add_column(column, **shape)
    for target in targets:
        note = () if notes is None else (notes.get(target.key, ""),)
        table.add_row(target.key, text_of(figures.get(target.key)), target.wanted, target.verdict(figures), *note)
    console.print(table)
