"""Renders the evaluation as one HTML file: verdicts, the paper's ratios, then each case study's charts and tables."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING

from bench.evaluation.targets import TARGETS
from bench.reporting.web import document, note_as_html, picture, table_as_html, verdicts_as_html

if TYPE_CHECKING:
    from bench.evaluation.report import Report, Section


def render(report: Report) -> str:
    """Return the whole page."""
    evidence = report.evidence
    verdicts = verdicts_as_html(TARGETS, evidence.figures, evidence.notes)
    ratios = f"<h2>Beside the paper</h2>{table_as_html(report.ratios)}" if report.ratios.rows else ""
    sections = "".join(map(_section, report.sections))
    return document("evaluation", f"{note_as_html(report.about)}{verdicts}{ratios}{sections}")


def _section(section: Section) -> str:
    parts = [f"<h2>{html.escape(section.title)}</h2>", note_as_html(section.about)]
    for chart in section.charts:
        parts += [picture(chart.svg, chart.about), note_as_html(chart.about)]
    parts += map(table_as_html, section.tables)
    if section.details:
        tables = "".join(map(table_as_html, section.details))
        parts.append(f"<details><summary>every window</summary>{tables}</details>")
    return "".join(parts)
