"""Makes others' text safe for a terminal or a log. Pure."""

from __future__ import annotations


def escaped(text: str) -> str:
    """Return `text` on one line, with unprintable characters replaced by escapes as `repr` writes them.

    An escape sequence would move the reader's cursor, and a line feed would begin a line that looks like one of ours.
    """
    if text.isprintable():
        return text
    return "".join(char if char.isprintable() else repr(char)[1:-1] for char in text)
