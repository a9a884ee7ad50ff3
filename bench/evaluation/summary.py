"""Renders the evaluation as Markdown: the page without the tables of every window; charts are files beside it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bench.evaluation.targets import TARGETS
from bench.reporting.tables import Table, table_as_markdown

if TYPE_CHECKING:
    from bench.evaluation.report import Report, Section

CHARTS = "evaluation-charts"
"""Folder of the charts beside the summary."""


def render(report: Report) -> str:
    """Return the whole file."""
    figures, notes = report.evidence.figures, report.evidence.notes
    columns = ("figure", "what", "value", "wanted", "verdict", "from")
    rows = tuple(
        (one.key, one.meaning, figures.get(one.key), one.wanted, one.verdict(figures), notes.get(one.key, ""))
        for one in TARGETS
    )
    parts = ["# FogROS2-PLR: evaluation", report.about, "## Targets", table_as_markdown(Table("", columns, rows))]
    if report.ratios.rows:
        parts += ["## Beside the paper", table_as_markdown(report.ratios)]
    for section in report.sections:
        parts += _section(section)
    return "\n\n".join(part.rstrip("\n") for part in parts) + "\n"


def _section(section: Section) -> list[str]:
    charts = [f"![{chart.about}]({CHARTS}/{chart.name}.svg)\n\n{chart.about}." for chart in section.charts]
    return [f"## {section.title}", section.about, *map(table_as_markdown, section.tables), *charts]
