"""Decides when to scan the local ROS graph, and how much of a scan to do in one go.

The ROS thread carries requests as well, and a scan of some hundred services takes tens of milliseconds. So a scan is a
generator of small steps, and a few of them run between two waits.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

TURN_S = 0.002
"""Time on the ROS thread in one go; with the longest step, this is how long a request may have to wait."""
REST = 9.0
"""Rest after a scan, as a multiple of its duration: a graph that changes all the time, as while a large system starts,
costs a tenth of the ROS thread."""
FIRST_SETTLING_S = 0.02
"""First pause between scans after a change, while one of our entities waits to be matched or for its time; it doubles
with each scan."""
IDLE_PERIOD_S = 5.0
"""Pause without any change: finds unreported changes, and serves work that has its own timing."""


class Scans:
    """Runs one scan after the other. `begin` returns a scan's steps; `settling`, whether another should follow soon."""

    def __init__(
        self,
        begin: Callable[[], Iterator[None]],
        settling: Callable[[], bool],
        now: float,
        clock: Callable[[], float] = time.thread_time,
    ) -> None:
        """Take as `clock` the thread's CPU time, so that a busy machine does not make scans rarer."""
        self._begin = begin
        self._settling = settling
        self._clock = clock
        self._steps: Iterator[None] | None = None
        self._took_s = 0.0
        self._due_at = now
        self._rested_at = now
        self._pause_s = FIRST_SETTLING_S
        self._changed = False

    def changed(self, now: float) -> None:
        """Note that the graph, or what is wanted of it, has changed."""
        self._pause_s = FIRST_SETTLING_S
        if self._steps is not None:
            self._changed = True
        else:
            self._due_at = min(self._due_at, max(now, self._rested_at))

    def next_due(self) -> float:
        """Return when `turn` has something to do; a time in the past while a scan is under way."""
        return float("-inf") if self._steps is not None else self._due_at

    def turn(self, now: float) -> None:
        """Continue the scan for about TURN_S, or begin one if it is due. An exception ends that scan, not the next."""
        if self._steps is None:
            if now < self._due_at:
                return
            self._steps, self._took_s, self._changed = self._begin(), 0.0, False
        began = self._clock()
        over = True
        try:
            for _ in self._steps:
                if self._clock() - began >= TURN_S:
                    over = False
                    return
        finally:
            worked_s = self._clock() - began
            self._took_s += worked_s
            if over:
                self._rest(now + worked_s)

    def _rest(self, now: float) -> None:
        self._steps = None
        self._rested_at = now + REST * self._took_s
        if self._changed:
            pause_s = 0.0
        elif self._settling():
            pause_s = min(self._pause_s, IDLE_PERIOD_S)
            self._pause_s *= 2.0
        else:
            pause_s = IDLE_PERIOD_S
        self._due_at = max(now + pause_s, self._rested_at)
