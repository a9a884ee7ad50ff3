"""Renders the report as one self-contained HTML file: verdicts, then each section's tables and plots."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING

from matplotlib.figure import Figure as Canvas

from bench.dataplane.targets import TARGETS
from bench.reporting.web import document, note_as_html, picture, svg_of, table_as_html, verdicts_as_html

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from bench.dataplane.report import Report
    from bench.dataplane.section import Findings, Plot


def render(report: Report) -> str:
    """Return the whole page."""
    machine = ", ".join(f"{key}: {value}" for key, value in report.machine.items())
    how = "quick run, figures are worth little" if report.quick else f"{report.repeats} repeats"
    sections = "".join(_section(report.titles[name], findings) for name, findings in report.sections.items())
    what = note_as_html(f"{how}; {machine}")
    return document("data plane", f"{what}{verdicts_as_html(TARGETS, report.figures, report.ranges())}{sections}")


def _section(title: str, findings: Findings) -> str:
    parts = [f"<h2>{html.escape(title)}</h2>"]
    parts += [table_as_html(table) for table in findings.tables]
    parts += [_image(plot) for plot in findings.plots]
    parts += [note_as_html(note) for note in findings.notes]
    return "".join(parts)


def _image(plot: Plot) -> str:
    canvas = Canvas(figsize=(9, 3.6), layout="constrained")
    axes = canvas.add_subplot()
    axes.set(title=plot.title, xlabel=plot.x_label, ylabel=plot.y_label)
    if plot.bars:
        _draw_bars(axes, plot.bars)
    for name, points in plot.lines.items():
        axes.plot([x for x, _ in points], [y for _, y in points], ".-", markersize=3, linewidth=0.8, label=name)
    if plot.lines:
        axes.legend(fontsize=8)
    if plot.log_y:
        axes.set_yscale("log")
    axes.grid(axis="y", alpha=0.3)
    return picture(svg_of(canvas), plot.title)


def _draw_bars(axes: Axes, bars: dict[str, float | None]) -> None:
    known = {name: value for name, value in bars.items() if value is not None}
    drawn = axes.bar(list(known), list(known.values()), width=0.6)
    axes.bar_label(drawn, fmt="%.3g", fontsize=8)
    axes.tick_params(axis="x", labelsize=8)
