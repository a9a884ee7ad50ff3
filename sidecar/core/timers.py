"""One timer for each key, the earliest first: a heap whose outdated entries are skipped."""

from __future__ import annotations

import heapq
import math
from itertools import count
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Hashable

NEVER = math.inf
"""A moment (s) that does not come."""
SLACK = 64
"""Outdated entries that may lie around before they are swept out; beyond it as many as there are live ones."""

K = TypeVar("K", bound="Hashable")


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
        """When the earliest timer is due."""
        self._skip_outdated()
        return self._heap[0][0] if self._heap else None

    def pop_due(self, now: float) -> K | None:
        """Disarm and return the key whose timer is due for longest; None when none is."""
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
