"""Cloud side: decides which answers are kept for copies that come late, within a number of bytes.

When there are too many, the robot that holds the most bytes loses its oldest answer: a greedy robot evicts its own.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName
    from plr.sidecar.core.base.values import RequestId


class AnswerCache:
    """Sizes of the kept answers, by robot and request; the answers themselves are the caller's."""

    __slots__ = ("_bytes", "_capacity", "_sizes", "held_bytes")

    def __init__(self, capacity: int) -> None:
        """Start empty; `capacity` is in bytes."""
        self._capacity = capacity
        # An OrderedDict removes the oldest cheaply: a dict walks over the holes at its front.
        self._sizes: dict[NodeName, OrderedDict[RequestId, int]] = {}
        self._bytes: dict[NodeName, int] = {}
        self.held_bytes = 0
        """Bytes held for all robots."""

    def add(self, robot: NodeName, request_id: RequestId, size: int) -> list[tuple[NodeName, RequestId]]:
        """Keep an answer of `size` bytes; return the answers to drop for it, possibly itself."""
        self._sizes.setdefault(robot, OrderedDict())[request_id] = size
        self._bytes[robot] = self._bytes.get(robot, 0) + size
        self.held_bytes += size
        evicted = []
        while self.held_bytes > self._capacity:
            greediest = max(self._bytes, key=self._bytes.__getitem__)
            oldest = next(iter(self._sizes[greediest]))
            self.remove(greediest, oldest)
            evicted.append((greediest, oldest))
        return evicted

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
