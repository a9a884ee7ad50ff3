"""The evaluation as one HTML file: what redundancy costs and avoids, then every window's table."""

from __future__ import annotations

import base64
import html
import io
from typing import TYPE_CHECKING

from matplotlib.figure import Figure as Canvas

from bench.reporting.web import STYLE, table_as_html

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from bench.evaluation.redundancy_costs import ModeCost
    from bench.reporting.tables import Table

COLUMNS = ("", "windows", "missed", "kB/request", "of replicate's avoided misses", "extra bytes over single")


def render(costs: Mapping[str, ModeCost], costs_table: Table, windows: Sequence[Table]) -> str:
    """The whole page."""
    modes = f"<h2>Redundancy modes</h2>{table_as_html(costs_table)}{_plot(costs)}" if costs else ""
    tables = "".join(map(table_as_html, windows))
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>FogROS2-PLR evaluation</title>'
        f"<style>{STYLE}</style></head><body><h1>FogROS2-PLR: evaluation</h1>{modes}<h2>Windows</h2>{tables}"
        "</body></html>\n"
    )


def _plot(costs: Mapping[str, ModeCost]) -> str:
    canvas = Canvas(figsize=(7, 4), layout="constrained")
    axes = canvas.add_subplot()
    for name, cost in costs.items():
        place = (cost.bytes_per_request / 1e3, cost.miss_ratio * 100)
        axes.plot(*place, "o")
        axes.annotate(name, place, textcoords="offset points", xytext=(6, 4), fontsize=8)
    title = "Missed deadlines against bytes sent"
    axes.set(title=title, xlabel="kB sent for each request", ylabel="missed, %")
    axes.set_ylim(bottom=0)
    axes.margins(x=0.2)
    axes.grid(alpha=0.3)
    image = io.BytesIO()
    canvas.savefig(image, format="svg")
    data = base64.b64encode(image.getvalue()).decode()
    return f'<p><img alt="{html.escape(title)}" src="data:image/svg+xml;base64,{data}"></p>'
