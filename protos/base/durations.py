"""Lengths of time in words, for people: a week in seconds says nothing to them."""

from __future__ import annotations


def in_words(duration_s: float) -> str:
    """Return so many seconds in the largest unit of which there are two."""
    for unit, seconds in (("days", 86_400.0), ("hours", 3600.0), ("minutes", 60.0)):
        if duration_s >= 2 * seconds:
            return f"{duration_s / seconds:.0f} {unit}"
    return f"{duration_s:.0f} seconds"
