"""Plots the predictions over the deadline: SVG (or another format of matplotlib), or one HTML page with the table."""

from __future__ import annotations

import html
import io
from typing import TYPE_CHECKING

from plr.controlplane.planning import plan_text

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from plr.controlplane.planning.prospects import Prospect, Source

SPAN = 8.0
"""Ratio of the axis limits to the given deadline: deadlines from 1/SPAN of it to SPAN times it are drawn."""

POINTS = 41


class PlotError(Exception):
    """The plot cannot be drawn or written; the text says why in one line."""


def draw(file: Path, source: Source, deadline_s: float, target: float | None) -> None:
    """Draw each set's miss probability over the deadline into `file`, by its suffix. Raises PlotError."""
    try:
        # Planning runs at an operator's desk: the control plane itself does not need matplotlib.
        from matplotlib.figure import Figure
    except ImportError:
        raise PlotError("--plot needs matplotlib: pip install matplotlib") from None
    deadlines = [deadline_s * SPAN ** (2.0 * point / (POINTS - 1) - 1.0) for point in range(POINTS)]
    curves: dict[tuple[int, int], list[Prospect]] = {}
    for prospects in map(source.prospects, deadlines):
        for found in prospects:
            curves.setdefault((found.interfaces, found.servers), []).append(found)
    canvas = Figure(figsize=(9, 5), layout="constrained")
    axes = canvas.add_subplot()
    axes.set(xlabel="deadline, ms", ylabel="predicted miss probability", xscale="log", yscale="log", title=source.title)
    axes.title.set_fontsize(8)
    at_ms = [deadline * 1e3 for deadline in deadlines]
    for number, ((interfaces, servers), found_at) in enumerate(curves.items()):
        colour = f"C{number}"
        name = f"{interfaces} interface{'s' * (interfaces > 1)}, {servers} server{'s' * (servers > 1)}"
        axes.plot(at_ms, [found.joint for found in found_at], color=colour, label=name)
        if interfaces > 1:
            axes.plot(at_ms, [found.product for found in found_at], color=colour, linestyle=":", linewidth=1)
    if curves:
        axes.plot([], [], color="grey", linestyle=":", linewidth=1, label="if independent")
    axes.axvline(deadline_s * 1e3, color="grey", linewidth=0.8)
    if target is not None:
        axes.axhline(target, color="grey", linewidth=0.8, linestyle="--", label=f"target {target:g}")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    image = io.BytesIO()
    kind = file.suffix.removeprefix(".").lower()
    try:
        canvas.savefig(image, format="svg" if kind == "html" else kind)
        file.write_bytes(_page(image.getvalue(), source, deadline_s, target) if kind == "html" else image.getvalue())
    except ValueError as error:
        raise PlotError(f"--plot {file}: expected a name that ends in .svg or .html: {error}") from None
    except OSError as error:
        raise PlotError(f"--plot {file}: {error.strerror or error}") from None


def _page(svg: bytes, source: Source, deadline_s: float, target: float | None) -> bytes:
    table: Sequence[str] = plan_text.render(source, source.prospects(deadline_s), deadline_s, target).splitlines()
    drawing = svg[svg.index(b"<svg") :]
    head = '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>plr plan</title></head><body><pre>'
    return head.encode() + html.escape("\n".join(table)).encode() + b"</pre>" + drawing + b"</body></html>\n"
