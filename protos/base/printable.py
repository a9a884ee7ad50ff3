"""Text of others on a terminal or in a log. Pure."""

from __future__ import annotations


def escaped(text: str) -> str:
    """`text` on one line, with escapes, as `repr` writes them, in place of what is not printable.

    An escape sequence would move the cursor of whoever reads it, a line feed begin a line that looks like one of ours.
    """
    if text.isprintable():
        return text
    return "".join(char if char.isprintable() else repr(char)[1:-1] for char in text)
