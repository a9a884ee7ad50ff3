"""When to solve again."""

from __future__ import annotations

import enum

URGENT_DELAY_S = 0.05
"""From a path's or a sidecar's coming or going to the next solving: time for what comes along with it (both
interfaces of a robot that enters a tunnel), and little beside the second a human would notice."""

ROUTINE_INTERVAL_S = 1.0
"""Between two solvings for the sake of new reports alone: estimates follow reports, which come twice a second,
and solving a large fleet takes about this long."""

ROUTINE_TIMES = 4.0
"""Routine solvings of a large fleet start this many times their own duration apart, to leave time for the rest."""


class Change(enum.Enum):
    """What changed the picture."""

    REPORT = "report"
    """New measurements."""
    PATH = "path"
    """A path went up or down."""
    MEMBERS = "members"
    """A sidecar, its addresses or its services came, went or changed."""


class Debounce:
    """Says when to solve. Times are monotonic seconds."""

    def __init__(self) -> None:
        self._due: float | None = None
        self._started = float("-inf")
        self._next_routine = float("-inf")
        self._running = False

    def note(self, change: Change, now: float) -> None:
        """The picture changed."""
        if change is Change.REPORT:
            at = max(now, self._next_routine)
        else:
            at = now + URGENT_DELAY_S
        self._due = at if self._due is None else min(self._due, at)

    def next_time(self) -> float | None:
        """When to solve; None while nothing changed, or while a solving runs."""
        return None if self._running else self._due

    def start(self, now: float) -> bool:
        """Whether to solve now; if so, `finished` has to follow."""
        due = self.next_time()
        if due is None or due > now:
            return False
        self._due = None
        self._started = now
        self._next_routine = now + ROUTINE_INTERVAL_S
        self._running = True
        return True

    def finished(self, now: float) -> None:
        """The solving that `start` began has ended."""
        self._running = False
        interval = max(ROUTINE_INTERVAL_S, ROUTINE_TIMES * (now - self._started))
        self._next_routine = self._started + interval
