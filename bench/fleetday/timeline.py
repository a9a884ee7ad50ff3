"""Simulated time: what happens when."""

from __future__ import annotations

import heapq
import itertools
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    Action = Callable[[], object]


class Timeline:
    """Actions in the order of their times, those of one time in the order they were asked for. Times are seconds."""

    def __init__(self, now: float) -> None:
        self.now = now
        self.done = 0
        """Actions carried out."""
        self._waiting: list[tuple[float, int, Action]] = []
        self._numbers = itertools.count()

    def __len__(self) -> int:
        return len(self._waiting)

    def at(self, when: float, action: Action) -> None:
        """Do this then, or now if that is over."""
        heapq.heappush(self._waiting, (max(when, self.now), next(self._numbers), action))

    def after(self, seconds: float, action: Action) -> None:
        """Do this so much later."""
        self.at(self.now + seconds, action)

    def run(self, until: float) -> None:
        """Let time pass."""
        waiting = self._waiting
        while waiting and waiting[0][0] <= until:
            self.now, _, action = heapq.heappop(waiting)
            self.done += 1
            action()
        self.now = until
