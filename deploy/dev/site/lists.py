"""Lists as Python-Markdown wants them, which the site is built with.

CommonMark, which forges follow, begins a list or the next item right behind a paragraph, and indents an item's text as
far as its marker. Python-Markdown wants an empty line between, and four spaces.
"""

from __future__ import annotations

import re

_ITEM = re.compile(r"(?:-|\d+\.) ")
_FENCE = re.compile(r"(`{3,})")
_INDENT = " " * 4


def adapt_lists(page: str) -> str:
    """Return the page with an empty line before lists and behind paragraphs of items, and items indented by four."""
    lines: list[str] = []
    fence = ""  # What ends the block of code that we are in, and is not within a list.
    margin = 0  # Of the item that we are in; 0 outside lists.
    paragraphs = False  # Whether that item has several.
    for line in page.split("\n"):
        if fence:
            if line.startswith(fence):
                fence = ""
        elif item := _ITEM.match(line):
            if (paragraphs or not margin) and lines and lines[-1]:
                lines.append("")
            margin = item.end()
            paragraphs = False
        elif margin and line.startswith(" " * margin):
            line = _INDENT + line[margin:]
            paragraphs |= not lines[-1]
        elif line:
            margin = 0
            if opening := _FENCE.match(line):
                fence = opening[1]
        lines.append(line)
    return "\n".join(lines)
