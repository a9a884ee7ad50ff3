"""Provides simulated time: runs actions at their times."""

from __future__ import annotations

import heapq
import itertools
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    Action = Callable[[], object]


class Timeline:
    """Actions in order of their times, and for equal times in order of scheduling. Times are seconds."""

    def __init__(self, now: float) -> None:
        self.now = now
        self.done = 0
        """Actions carried out."""
        self._waiting: list[tuple[float, int, Action]] = []
        self._numbers = itertools.count()

    def __len__(self) -> int:
        return len(self._waiting)

    def at(self, when: float, action: Action) -> None:
        """Schedule an action for this time, or for now if that has passed."""
        heapq.heappush(self._waiting, (max(when, self.now), next(self._numbers), action))

    def after(self, seconds: float, action: Action) -> None:
        """Schedule an action this many seconds from now."""
        self.at(self.now + seconds, action)

    def run(self, until: float) -> None:
        """Let time pass until `until`."""
        waiting = self._waiting
        while waiting and waiting[0][0] <= until:
            self.now, _, action = heapq.heappop(waiting)
            self.done += 1
            action()
        self.now = until
