"""Remembers which robots have reached which servers: whose silence tells something of a server.

A robot may know servers that no network leads it to (another site's). That it does not reach these says nothing; that
it does not reach one that it did reach does. One robot may be hacked: if nobody else ever reached a server, that this
robot reaches it, or did, proves nothing against two that do not.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName

MAX_REACHED_PAIRS = 131_072
"""Pairs of robot and server remembered, also of robots that are gone: as many as 4,096 robots and 32 servers make. The
one that reached longest ago is evicted."""


class Reached:
    """The pairs that reached each other since the start."""

    def __init__(self) -> None:
        self._pairs: OrderedDict[tuple[NodeName, NodeName], None] = OrderedDict()
        """The least recently noted pair first."""
        self._servers_of: dict[NodeName, set[NodeName]] = {}
        self._robots_of: Counter[NodeName] = Counter()
        self.forgotten = 0

    def __len__(self) -> int:
        return len(self._pairs)

    def note(self, robot: NodeName, server: NodeName) -> None:
        """Note that the robot reaches the server now."""
        pair = (robot, server)
        known = pair in self._pairs
        self._pairs[pair] = None
        if known:
            self._pairs.move_to_end(pair)
            return
        self._servers_of.setdefault(robot, set()).add(server)
        self._robots_of[server] += 1
        if len(self._pairs) > MAX_REACHED_PAIRS:
            self._drop(*next(iter(self._pairs)))
            self.forgotten += 1

    def _drop(self, robot: NodeName, server: NodeName) -> None:
        del self._pairs[robot, server]
        servers = self._servers_of[robot]
        servers.remove(server)
        if not servers:
            del self._servers_of[robot]
        self._robots_of[server] -= 1
        if not self._robots_of[server]:
            del self._robots_of[server]

    def forget(self, robot: NodeName) -> None:
        """Discard everything noted of this robot."""
        for server in list(self._servers_of.get(robot, ())):
            self._drop(robot, server)

    def by(self, robot: NodeName, server: NodeName) -> bool:
        """Return whether this robot ever reached the server."""
        return (robot, server) in self._pairs

    def witnesses(self, server: NodeName) -> int:
        """Return how many robots, present or gone, ever reached the server."""
        return self._robots_of[server]
