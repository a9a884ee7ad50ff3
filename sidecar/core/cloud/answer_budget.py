"""Cloud side: decides which answers are kept for copies that come late, within a number of bytes.

When there are too many, the robot that holds the most bytes loses its oldest answer: a greedy robot evicts its own. A
large answer may take the place of very many small ones. They go over several calls, so that no call takes long: until
then more is held than the capacity.
"""

from __future__ import annotations

import heapq
from collections import OrderedDict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName
    from plr.sidecar.core.base.values import RequestId


EVICTED_AT_ONCE = 1024
"""Answers that one call evicts: a few milliseconds."""
HEAP_SLACK = 1024
"""Outdated entries that may remain in the heap before it is built again."""


class AnswerBudget:
    """Sizes of the kept answers, by robot and request; the answers themselves are the caller's."""

    __slots__ = ("_bytes", "_capacity", "_greediest", "_sizes", "held_bytes")

    def __init__(self, capacity: int) -> None:
        """Start empty; `capacity` is in bytes."""
        self._capacity = capacity
        # An OrderedDict removes the oldest cheaply: a dict walks over the holes at its front.
        self._sizes: dict[NodeName, OrderedDict[RequestId, int]] = {}
        self._bytes: dict[NodeName, int] = {}
        self._greediest: list[tuple[int, NodeName]] = []
        """Heap of (negative bytes, robot): an entry for each time that a robot came to hold more. Most are outdated."""
        self.held_bytes = 0
        """Bytes held for all robots."""

    def add(self, robot: NodeName, request_id: RequestId, size: int) -> list[tuple[NodeName, RequestId]]:
        """Keep an answer of `size` bytes; return the answers to drop for it, possibly itself."""
        self._sizes.setdefault(robot, OrderedDict())[request_id] = size
        self._bytes[robot] = self._bytes.get(robot, 0) + size
        self.held_bytes += size
        heapq.heappush(self._greediest, (-self._bytes[robot], robot))
        if len(self._greediest) > 2 * len(self._bytes) + HEAP_SLACK:
            self._greediest = [(-held, name) for name, held in self._bytes.items()]
            heapq.heapify(self._greediest)
        evicted: list[tuple[NodeName, RequestId]] = []
        while self.held_bytes > self._capacity and len(evicted) < EVICTED_AT_ONCE:
            greediest = self._find_greediest()
            oldest = next(iter(self._sizes[greediest]))
            self.remove(greediest, oldest)
            evicted.append((greediest, oldest))
        return evicted

    def _find_greediest(self) -> NodeName:
        """Return the robot that holds the most; correct entries at the top that say more than is true now."""
        heap, held = self._greediest, self._bytes
        while held.get(heap[0][1], 0) != -heap[0][0]:
            robot = heap[0][1]
            if robot in held and held[robot] < -heap[0][0]:
                heapq.heapreplace(heap, (-held[robot], robot))
            else:
                heapq.heappop(heap)
        return heap[0][1]

    def remove(self, robot: NodeName, request_id: RequestId) -> None:
        """Stop keeping this answer, if it is kept."""
        sizes = self._sizes.get(robot)
        if sizes is None or request_id not in sizes:
            return
        size = sizes.pop(request_id)
        self.held_bytes -= size
        self._bytes[robot] -= size
        if not sizes:
            del self._sizes[robot], self._bytes[robot]
