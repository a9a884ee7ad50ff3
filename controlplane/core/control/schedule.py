"""Decides when to solve again."""

from __future__ import annotations

import enum

URGENT_DELAY_S = 0.05
"""Delay from a path or sidecar coming or going to the next solving: time for what comes along with it (both interfaces
of a robot that enters a tunnel), and little compared with the second a human would notice."""

ROUTINE_INTERVAL_S = 1.0
"""Interval between two solvings because of new reports alone: estimates follow reports, which come twice a second, and
solving a large fleet takes about this long."""

ROUTINE_TIMES = 10.0
"""Routine solvings of a large fleet start this many times their own duration apart, to leave time for the rest."""

ROBOTS_TIMES = 4.0
"""Robots that come wait for the next solving for this many times the last one's duration. A returning fleet keeps its
mappings meanwhile. Each solving examines everybody, so the more robots are present, the more one solving for every few
newcomers would cost per newcomer."""

ROBOTS_WAIT_S = 2.0
"""Maximum time that they wait."""


class Change(enum.Enum):
    """What changed the picture."""

    REPORT = "report"
    """New measurements."""
    PATH = "path"
    """A path went up or down."""
    MISSES = "misses"
    """A robot misses far more deadlines than was believed."""
    MEMBERS = "members"
    """A server, its addresses or its services came, went or changed, or the policy."""

    ROBOTS = "robots"
    """A robot, its addresses or its services came, went or changed."""


class Debounce:
    """Says when to solve. Times are monotonic seconds."""

    def __init__(self) -> None:
        self._urgent: Change | None = None
        self._urgent_at = float("-inf")
        self._reported_at: float | None = None
        self._next_routine = float("-inf")
        self._robots_at: float | None = None
        self._next_robots = float("-inf")
        self._started = float("-inf")
        self._running = False

    def note(self, change: Change, now: float) -> None:
        """Note that the picture changed."""
        if change is Change.REPORT:
            self._reported_at = self._reported_at if self._reported_at is not None else now
        elif change is Change.ROBOTS:
            if self._robots_at is None:
                self._robots_at = now + URGENT_DELAY_S
        elif self._urgent is None:
            self._urgent = change
            self._urgent_at = now + URGENT_DELAY_S

    def go_on(self, now: float) -> None:
        """Note that the present solving does not cover everything urgent: the next one follows at once."""
        self._urgent = self._urgent or Change.PATH
        self._urgent_at = now

    def next_time(self) -> float | None:
        """Return when to solve; None while nothing has changed, or while a solving runs."""
        if self._running:
            return None
        times = [self._urgent_at] if self._urgent is not None else []
        if self._reported_at is not None:
            times.append(max(self._reported_at, self._next_routine))
        if self._robots_at is not None:
            times.append(max(self._robots_at, self._next_robots))
        return min(times, default=None)

    def start(self, now: float) -> Change | None:
        """Return what to solve for now, if anything; `finished` has to follow. `REPORT`: for everything."""
        due = self.next_time()
        if due is None or due > now:
            return None
        routine = self._reported_at is not None and self._next_routine <= now
        change = Change.REPORT if routine else self._urgent or Change.ROBOTS
        self._urgent = self._robots_at = None
        if routine:
            self._reported_at = None
            self._next_routine = now + ROUTINE_INTERVAL_S
        self._started = now
        self._running = True
        return change

    def finished(self, now: float) -> None:
        """Note that the solving that `start` began has ended."""
        self._running = False
        took_s = now - self._started
        self._next_routine = max(self._next_routine, self._started + ROUTINE_TIMES * took_s)
        self._next_robots = now + min(ROBOTS_TIMES * took_s, ROBOTS_WAIT_S)
