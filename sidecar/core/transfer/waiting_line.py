"""Orders what waits for room, and decides who is next.

Urgent before bulk; within a priority, those in time before late ones, earliest deadline first. The next one keeps its
turn while it does not fit: a large one gets the room that smaller ones would otherwise take again and again. No
priority starves: while a lower one waits, it gets one byte in SHARE.
"""

from __future__ import annotations

import heapq
from itertools import count
from typing import TYPE_CHECKING, Generic, NamedTuple, TypeVar

from plr.sidecar.core.base.values import SHARE, Priority

if TYPE_CHECKING:
    from collections.abc import Hashable

    Key = TypeVar("Key", bound=Hashable)
else:
    Key = TypeVar("Key")

SLACK = 64
"""Outdated places in line that may remain before a sweep."""


class _Place(NamedTuple):
    priority: Priority
    deadline: float
    order: int
    size: int


class _Class(Generic[Key]):
    """The keys of one priority."""

    __slots__ = ("fresh", "late", "passed_over", "waiting")

    def __init__(self) -> None:
        self.fresh: list[tuple[float, int, Key]] = []
        """Heaps by deadline; ended keys that have not come up yet remain in them."""
        self.late: list[tuple[float, int, Key]] = []
        self.waiting = 0
        self.passed_over = 0
        """Bytes of higher priorities that went while something waited here."""


class WaitingLine(Generic[Key]):
    """Keys of what waits for the same room. Their owner limits their number."""

    __slots__ = ("_classes", "_order", "_places")

    def __init__(self) -> None:
        self._classes: tuple[_Class[Key], ...] = tuple(_Class() for _ in Priority)
        self._places: dict[Key, _Place] = {}
        self._order = count()

    def __len__(self) -> int:
        return len(self._places)

    def add(self, key: Key, priority: Priority, deadline: float, size: int) -> None:
        """Add a key that is not waiting yet."""
        place = self._places[key] = _Place(priority, deadline, next(self._order), size)
        mine = self._classes[priority]
        mine.waiting += 1
        heapq.heappush(mine.fresh, (deadline, place.order, key))
        if len(mine.fresh) + len(mine.late) > 2 * mine.waiting + SLACK:
            for heap in (mine.fresh, mine.late):
                heap[:] = [item for item in heap if self._waits(item)]
                heapq.heapify(heap)

    def first(self, now: float) -> Key | None:
        """Return the key whose turn it is; None if none waits."""
        heads = [(each, key) for each in self._classes if (key := self._head(each, now)) is not None]
        for lower, key in reversed(heads[1:]):
            if lower.passed_over >= SHARE * self._places[key].size:
                return key
        return heads[0][1] if heads else None

    def _head(self, each: _Class[Key], now: float) -> Key | None:
        while each.fresh:
            item = each.fresh[0]
            if self._waits(item):
                if item[0] > now:
                    return item[2]
                heapq.heappush(each.late, item)
            heapq.heappop(each.fresh)
        while each.late:
            if self._waits(each.late[0]):
                return each.late[0][2]
            heapq.heappop(each.late)
        return None

    def _waits(self, item: tuple[float, int, Key]) -> bool:
        place = self._places.get(item[2])
        return place is not None and place.order == item[1]

    def went(self, key: Key) -> None:
        """Remove a key that had its turn and found room."""
        place = self._places[key]
        self.remove(key)
        self._classes[place.priority].passed_over = 0
        for lower in self._classes[place.priority + 1 :]:
            if lower.waiting:
                lower.passed_over += place.size

    def remove(self, key: Key) -> None:
        """Remove a key, if it waits."""
        place = self._places.pop(key, None)
        if place is not None:
            mine = self._classes[place.priority]
            mine.waiting -= 1
            if not mine.waiting:
                mine.passed_over = 0
