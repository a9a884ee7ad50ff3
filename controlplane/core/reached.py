"""Which robots have reached which servers: whose silence tells something of a server.

A robot may be told of servers that no network leads it to (another site's). That it does not reach these says nothing;
that it does not reach one that it did reach does.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from protos.model import NodeName

MAX_PAIRS = 131_072
"""Pairs of robot and server remembered, also of robots that are gone; the one that reached longest ago goes. As many as
4,096 robots and 32 servers make."""


class Reached:
    """Remembers it since the start."""

    def __init__(self) -> None:
        self._pairs: OrderedDict[tuple[NodeName, NodeName], None] = OrderedDict()
        self._robots_of: Counter[NodeName] = Counter()
        self.forgotten = 0

    def __len__(self) -> int:
        return len(self._pairs)

    def note(self, robot: NodeName, server: NodeName) -> None:
        """The robot reaches the server now."""
        pair = (robot, server)
        if pair in self._pairs:
            self._pairs.move_to_end(pair)
            return
        self._pairs[pair] = None
        self._robots_of[server] += 1
        if len(self._pairs) > MAX_PAIRS:
            (_, other), _ = self._pairs.popitem(last=False)
            self._robots_of[other] -= 1
            if not self._robots_of[other]:
                del self._robots_of[other]
            self.forgotten += 1

    def by(self, robot: NodeName, server: NodeName) -> bool:
        """Whether this robot has ever reached the server."""
        return (robot, server) in self._pairs

    def by_anyone(self, server: NodeName) -> bool:
        """Whether any robot, there or gone, has."""
        return server in self._robots_of
