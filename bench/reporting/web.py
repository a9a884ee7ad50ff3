"""Makes self-contained HTML: one file that includes its pictures."""

from __future__ import annotations

import base64
import html
import io
import re
from typing import TYPE_CHECKING

from matplotlib import rc_context

from bench.reporting.tables import text_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.figure import Figure as Canvas

    from bench.reporting.tables import Figure, Table
    from bench.reporting.targets import Target

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 62rem; padding: 0 1rem; color: #1b1f24; }
table { border-collapse: collapse; margin: 1rem 0; }
caption { text-align: left; font-weight: 600; padding: .3rem 0; }
th, td { padding: .25rem .8rem; border-bottom: 1px solid #d8dee4; text-align: right; }
th:first-child, td:first-child, td.text { text-align: left; }
.met { color: #1a7f37; } .missed { color: #cf222e; font-weight: 600; } .not { color: #6e7781; }
img { max-width: 100%; } .note { color: #57606a; }
"""


def document(title: str, body: str) -> str:
    """Return the whole page; `title` is text, `body` is HTML."""
    shown = html.escape(title)
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>FogROS2-PLR {shown}</title>'
        f"<style>{STYLE}</style></head><body><h1>FogROS2-PLR: {shown}</h1>{body}</body></html>\n"
    )


def note_as_html(text: str) -> str:
    """Return a remark in small print."""
    return f'<p class="note">{html.escape(text)}</p>'


def table_as_html(table: Table) -> str:
    """Return a table with its title as the caption."""
    heads = "".join(f"<th>{html.escape(column)}</th>" for column in table.columns)
    rows = "".join(
        "<tr>" + "".join(f"<td>{html.escape(text_of(cell))}</td>" for cell in row) + "</tr>" for row in table.rows
    )
    return f"<table><caption>{html.escape(table.title)}</caption><tr>{heads}</tr>{rows}</table>"


def verdicts_as_html(
    targets: Sequence[Target], figures: Mapping[str, Figure], notes: Mapping[str, str] | None = None
) -> str:
    """Return which targets are met and missed; `notes` explain figures, by name."""
    rows = []
    for target in targets:
        verdict = target.verdict(figures)
        shown = "".join(f'<td class="text">{html.escape(cell)}</td>' for cell in (target.key, target.meaning))
        shown += f'<td>{text_of(figures.get(target.key))}</td><td class="text">{html.escape(target.wanted)}</td>'
        shown += f'<td class="{verdict.split()[0]}">{verdict}</td>'
        if notes is not None:
            shown += f'<td class="text note">{html.escape(notes.get(target.key, ""))}</td>'
        rows.append(f"<tr>{shown}</tr>")
    columns = ("figure", "what", "value", "wanted", "verdict", *(("from",) if notes is not None else ()))
    heads = "".join(f"<th>{column}</th>" for column in columns)
    return f"<h2>Targets</h2><table><tr>{heads}</tr>{''.join(rows)}</table>"


def svg_of(canvas: Canvas) -> bytes:
    """Return the drawing as a file; the same drawing always gives the same bytes.

    It is small enough to be kept beside sources: letters are text, lines are exact to a hundredth of a point.
    """
    image = io.BytesIO()
    with rc_context({"svg.hashsalt": "plr", "svg.fonttype": "none", "font.sans-serif": ["DejaVu Sans"]}):
        canvas.savefig(image, format="svg", metadata={"Date": None})
    return re.sub(rb' d="[^"]*"', lambda drawn: re.sub(rb"(\.\d\d)\d+", rb"\1", drawn[0]), image.getvalue())


def picture(svg: bytes, alt: str) -> str:
    """Return a drawing embedded in the page."""
    data = base64.b64encode(svg).decode()
    return f'<p><img alt="{html.escape(alt)}" src="data:image/svg+xml;base64,{data}"></p>'
