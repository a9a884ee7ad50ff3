"""Aligns columns for a terminal. Text of one member stays on its own line, and is cut to a readable length."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

MAX_PADDED = 64
"""Widest padding in characters: one long cell does not widen the column for the others."""

MAX_LIST_CHARACTERS = 100
"""Characters of a list in one cell."""


def columns(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Yield a line for each row, each column as wide as its widest cell, up to MAX_PADDED."""
    if not rows:
        return
    widths = [min(max(len(cell) for cell in column), MAX_PADDED) for column in zip(*rows, strict=True)]
    for row in rows:
        yield "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()


def listed(names: Sequence[str]) -> str:
    """Return the first of these for one cell, at least one, and how many more there are; "-" if there are none."""
    if not names:
        return "-"
    shown = [shortened(names[0], MAX_LIST_CHARACTERS)]
    room = MAX_LIST_CHARACTERS - len(shown[0])
    for name in names[1:]:
        room -= 1 + len(name)
        if room < 0:
            break
        shown.append(name)
    more = len(names) - len(shown)
    return ",".join(shown) + (f" and {more} more" if more else "")


def shortened(text: str, most: int) -> str:
    """Cut out the middle of a text of more than `most` characters."""
    if len(text) <= most:
        return text
    end = (most - 3) // 2
    return f"{text[: most - 3 - end]}...{text[-end:]}"
