"""Defines a finding: one line of the output of `plr doctor`."""

from __future__ import annotations

import enum
from dataclasses import dataclass


class Level(enum.Enum):
    """Severity of a finding."""

    OK = "ok"
    WARN = "warn"
    """It works, or may work, but somebody should look."""
    FAIL = "fail"
    """Something does not work."""


@dataclass(frozen=True, slots=True)
class Finding:
    """What a check found."""

    level: Level
    check: str
    """Subject of the check: certificate, clock, ..."""
    text: str
    remedy: str = ""
    """What to do; empty with ok."""


def ok(check: str, text: str) -> Finding:
    """Return a finding that all is well."""
    return Finding(Level.OK, check, text)


def warn(check: str, text: str, remedy: str) -> Finding:
    """Return a finding that somebody should look at."""
    return Finding(Level.WARN, check, text, remedy)


def fail(check: str, text: str, remedy: str) -> Finding:
    """Return a finding that something does not work."""
    return Finding(Level.FAIL, check, text, remedy)


def duration(seconds: float) -> str:
    """Return a duration as people say it: 3 s, 12 min, 5 h, 40 days."""
    for unit, length in (("days", 86_400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.0f} {unit}"
    return f"{max(0.0, seconds):.0f} s"


def milliseconds(seconds: float) -> str:
    """Return a time in milliseconds."""
    return f"{seconds * 1000:.1f} ms" if seconds < 1.0 else f"{seconds * 1000:.0f} ms"


def share(part: float) -> str:
    """Return a share in per cent; small ones get more digits."""
    return f"{part * 100:.3g} %"
