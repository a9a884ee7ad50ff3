"""Writes durations in words for people, to whom a week in seconds says nothing."""

from __future__ import annotations


def in_words(duration_s: float) -> str:
    """Return a duration in the largest unit of which it has at least two."""
    for unit, seconds in (("days", 86_400.0), ("hours", 3600.0), ("minutes", 60.0)):
        if duration_s >= 2 * seconds:
            return f"{duration_s / seconds:.0f} {unit}"
    return f"{duration_s:.0f} seconds"
