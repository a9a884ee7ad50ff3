"""The report as one HTML file: verdicts, then each section's tables and plots. Nothing is loaded from elsewhere."""

from __future__ import annotations

import base64
import html
import io
from typing import TYPE_CHECKING

from matplotlib.figure import Figure as Canvas

from bench.dataplane.targets import TARGETS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from bench.dataplane.report import Report
    from bench.dataplane.section import Figure, Findings, Plot, Table

VERDICTS = {True: "met", False: "missed", None: "not measured"}

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 62rem; padding: 0 1rem; color: #1b1f24; }
table { border-collapse: collapse; margin: 1rem 0; }
caption { text-align: left; font-weight: 600; padding: .3rem 0; }
th, td { padding: .25rem .8rem; border-bottom: 1px solid #d8dee4; text-align: right; }
th:first-child, td:first-child, td.text { text-align: left; }
.met { color: #1a7f37; } .missed { color: #cf222e; font-weight: 600; } .not { color: #6e7781; }
img { max-width: 100%; } .note { color: #57606a; }
"""


def render(report: Report) -> str:
    """The whole page."""
    machine = ", ".join(f"{key}: {value}" for key, value in report.machine.items())
    how = "quick run, figures are worth little" if report.quick else f"medians of {report.repeats} repeats"
    sections = "".join(_section(report.titles[name], findings) for name, findings in report.sections.items())
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>FogROS2-PLR data plane</title>'
        f"<style>{STYLE}</style></head><body><h1>FogROS2-PLR: data plane</h1>"
        f'<p class="note">{html.escape(how)}; {html.escape(machine)}</p>{_verdicts(report.figures)}{sections}'
        "</body></html>\n"
    )


def text_of(cell: str | Figure) -> str:
    """A cell for people."""
    if cell is None:
        return "-"
    if isinstance(cell, str | int):
        return str(cell)
    return f"{cell:.0f}" if abs(cell) >= 1000 else f"{cell:.3g}"


def _verdicts(figures: dict[str, Figure]) -> str:
    rows = []
    for target in TARGETS:
        verdict = VERDICTS[target.met(figures)]
        cells = (target.key, target.meaning, text_of(figures.get(target.key)), target.wanted)
        shown = "".join(
            f'<td class="text">{html.escape(c)}</td>' if i != 2 else f"<td>{c}</td>" for i, c in enumerate(cells)
        )
        rows.append(f'<tr>{shown}<td class="{verdict.split()[0]}">{verdict}</td></tr>')
    heads = "".join(f"<th>{head}</th>" for head in ("figure", "what", "value", "wanted", "verdict"))
    return f"<h2>Targets</h2><table><tr>{heads}</tr>{''.join(rows)}</table>"


def _section(title: str, findings: Findings) -> str:
    parts = [f"<h2>{html.escape(title)}</h2>"]
    parts += [table_as_html(table) for table in findings.tables]
    parts += [_image(plot) for plot in findings.plots]
    parts += [f'<p class="note">{html.escape(note)}</p>' for note in findings.notes]
    return "".join(parts)


def table_as_html(table: Table) -> str:
    """One table, its title as the caption."""
    heads = "".join(f"<th>{html.escape(column)}</th>" for column in table.columns)
    rows = "".join(
        "<tr>" + "".join(f"<td>{html.escape(text_of(cell))}</td>" for cell in row) + "</tr>" for row in table.rows
    )
    return f"<table><caption>{html.escape(table.title)}</caption><tr>{heads}</tr>{rows}</table>"


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
    image = io.BytesIO()
    canvas.savefig(image, format="svg")
    data = base64.b64encode(image.getvalue()).decode()
    return f'<p><img alt="{html.escape(plot.title)}" src="data:image/svg+xml;base64,{data}"></p>'


def _draw_bars(axes: Axes, bars: dict[str, float | None]) -> None:
    known = {name: value for name, value in bars.items() if value is not None}
    drawn = axes.bar(list(known), list(known.values()), width=0.6)
    axes.bar_label(drawn, fmt="%.3g", fontsize=8)
    axes.tick_params(axis="x", labelsize=8)
