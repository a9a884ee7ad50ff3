"""Keeps requests that wait for a local server in the cloud, in the order in which they should run.

More urgent requests go first; then those that can still make their deadline before late ones; then the earlier
deadline. Late ones are served last, not dropped: their robots still want the answers until they expire. Requests that
will expire before they are answered come after all others. At a server that is overloaded for long, the oldest always
do, and it would work for nobody.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field
from itertools import count
from typing import TYPE_CHECKING, Generic, TypeVar

from plr.sidecar.core.base.values import Priority

if TYPE_CHECKING:
    from collections.abc import Hashable

REMOVED_SLACK = 64
"""Removed requests that may remain in the heaps before they are swept out."""

T = TypeVar("T", bound="Hashable")


@dataclass(slots=True)
class _Class(Generic[T]):
    """Waiting requests of one priority: heaps of (deadline, order of arrival, request, when it expires)."""

    fresh: list[tuple[float, int, T, float]] = field(default_factory=list)
    late: list[tuple[float, int, T, float]] = field(default_factory=list)
    hopeless: list[tuple[float, int, T, float]] = field(default_factory=list)
    """Ordered by expiry instead of deadline, the last to expire first."""

    def heaps(self) -> tuple[list[tuple[float, int, T, float]], ...]:
        """Return all heaps in the order to serve them."""
        return self.fresh, self.late, self.hopeless


class RequestQueue(Generic[T]):
    """Requests by priority, lateness and deadline. Times are in seconds; the caller limits the number of requests."""

    __slots__ = ("_classes", "_order", "_waiting")

    def __init__(self) -> None:
        self._classes: dict[Priority, _Class[T]] = {priority: _Class() for priority in sorted(Priority)}
        self._waiting: dict[T, None] = {}
        """Waiting requests in order of arrival; a removed one stays in its heap until it reaches the top."""
        self._order = count()

    def __len__(self) -> int:
        return len(self._waiting)

    def __contains__(self, request: T) -> bool:
        return request in self._waiting

    def add(self, request: T, priority: Priority, deadline: float, expires: float) -> None:
        """Queue a request, until `remove` at the latest."""
        self._waiting[request] = None
        heapq.heappush(self._classes[priority].fresh, (deadline, next(self._order), request, expires))

    def remove(self, request: T) -> None:
        """Remove a request that is no longer wanted."""
        del self._waiting[request]
        held = sum(len(heap) for waiting in self._classes.values() for heap in waiting.heaps())
        if held > 2 * len(self._waiting) + REMOVED_SLACK:
            for waiting in self._classes.values():
                for heap in waiting.heaps():
                    heap[:] = [entry for entry in heap if entry[2] in self._waiting]
                    heapq.heapify(heap)

    def take(self, now: float, hopeless_by: float, *, late_too: bool) -> tuple[T, bool] | None:
        """Return the request whose turn it is and whether it is late, or None if none may be taken.

        Late requests that expire by `hopeless_by` come after all others, whatever their priority.
        """
        for waiting in self._classes.values():
            self._sort_out(waiting, now, hopeless_by)
            heap = waiting.fresh or (waiting.late if late_too else None)
            if heap:
                return self._pop(heap), heap is waiting.late
        if late_too:
            for waiting in self._classes.values():
                if waiting.hopeless:
                    return self._pop(waiting.hopeless), True
        return None

    def _pop(self, heap: list[tuple[float, int, T, float]]) -> T:
        request = heapq.heappop(heap)[2]
        del self._waiting[request]
        return request

    def _sort_out(self, waiting: _Class[T], now: float, hopeless_by: float) -> None:
        """Bring the requests that may be taken to the top of the heaps."""
        while waiting.fresh and (waiting.fresh[0][0] <= now or waiting.fresh[0][2] not in self._waiting):
            entry = heapq.heappop(waiting.fresh)
            if entry[2] in self._waiting:
                heapq.heappush(waiting.late, entry)
        while waiting.late and (waiting.late[0][3] <= hopeless_by or waiting.late[0][2] not in self._waiting):
            _, order, request, expires = heapq.heappop(waiting.late)
            if request in self._waiting:
                heapq.heappush(waiting.hopeless, (-expires, order, request, expires))
        while waiting.hopeless and waiting.hopeless[0][2] not in self._waiting:
            heapq.heappop(waiting.hopeless)

    def take_all(self) -> list[T]:
        """Remove and return all requests, in order of arrival."""
        requests = list(self._waiting)
        self._waiting.clear()
        for waiting in self._classes.values():
            for heap in waiting.heaps():
                heap.clear()
        return requests
