"""Keeps one timer for each key, the earliest first, in a heap whose outdated entries are skipped."""

from __future__ import annotations

import heapq
import math
from itertools import count
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Container, Hashable

NEVER = math.inf
"""A time (s) that never comes."""
SLACK = 64
"""Outdated entries kept before a sweep, on top of as many as there are live ones."""

SKIPPED_AT_ONCE = 128
"""Outdated entries dropped in one look at a heap: a fraction of a millisecond."""

K = TypeVar("K", bound="Hashable")


def first_of(heap: list[tuple[float, K]], live: Container[K]) -> float | None:
    """Drop leading timers whose keys are not live, and return when the first remaining one is due.

    It drops only SKIPPED_AT_ONCE: after a burst of ended keys it may return the time of an ended one.
    """
    for _ in range(SKIPPED_AT_ONCE):
        if not heap or heap[0][1] in live:
            break
        heapq.heappop(heap)
    return heap[0][0] if heap else None


class Timers(Generic[K]):
    """Timers by key; arming a key again replaces its timer."""

    __slots__ = ("_due", "_heap", "_order")

    def __init__(self) -> None:
        self._due: dict[K, float] = {}
        self._heap: list[tuple[float, int, K]] = []
        self._order = count()

    def arm(self, key: K, due: float | None) -> None:
        """Set the key's timer; None disarms it."""
        if due is None:
            self._due.pop(key, None)
        elif self._due.get(key) != due:
            self._due[key] = due
            heapq.heappush(self._heap, (due, next(self._order), key))
            if len(self._heap) > 2 * len(self._due) + SLACK:
                self._heap = [(at, order, key) for at, order, key in self._heap if self._due.get(key) == at]
                heapq.heapify(self._heap)

    def next(self) -> float | None:
        """Return when the earliest timer is due."""
        self._skip_outdated()
        return self._heap[0][0] if self._heap else None

    def pop_due(self, now: float) -> K | None:
        """Disarm and return the key whose timer has been due longest; None if none is."""
        self._skip_outdated()
        if not self._heap or self._heap[0][0] > now:
            return None
        key = heapq.heappop(self._heap)[2]
        del self._due[key]
        return key

    def _skip_outdated(self) -> None:
        heap = self._heap
        while heap and self._due.get(heap[0][2]) != heap[0][0]:
            heapq.heappop(heap)
