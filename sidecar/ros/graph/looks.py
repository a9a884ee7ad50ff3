"""When the local ROS graph is looked at, and how much of a look is done in one go.

The ROS thread carries requests as well, and a look at some hundred services takes tens of milliseconds. So a look is a
generator of small steps, of which a few are done between two waits.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

TURN_S = 0.002
"""Of the ROS thread in one go; what a request may have to wait for, together with the longest step."""
REST = 9.0
"""A look that took so long is followed by a rest of this many times as long: graphs that change all the time, as while
a large system starts, cost a tenth of the ROS thread."""
FIRST_SETTLING_S = 0.02
"""After a change, while an entity of ours waits to be matched or for its time: the pause until the next look, which is
doubled from look to look."""
IDLE_PERIOD_S = 5.0
"""Without any change: against one that was not told of, and for what has a time of its own."""


class Looks:
    """One look after the other. `begin` returns a look's steps, `settling` whether another one should follow soon."""

    def __init__(
        self,
        begin: Callable[[], Iterator[None]],
        settling: Callable[[], bool],
        now: float,
        clock: Callable[[], float] = time.thread_time,
    ) -> None:
        """`clock`: what the thread has worked, so that looks are not rarer because others keep the machine busy."""
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
        """The graph, or what is wanted of it, is another one."""
        self._pause_s = FIRST_SETTLING_S
        if self._steps is not None:
            self._changed = True
        else:
            self._due_at = min(self._due_at, max(now, self._rested_at))

    def next_due(self) -> float:
        """Return when `turn` has something to do; a time that is over while a look is under way."""
        return float("-inf") if self._steps is not None else self._due_at

    def turn(self, now: float) -> None:
        """Look on for about TURN_S, if it is time. What a step raises ends that look, not the next one."""
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
