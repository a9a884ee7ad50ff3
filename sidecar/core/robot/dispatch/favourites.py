"""Robot side: remembers the server to which shared requests of each service go, and when another one is tried.

Shared requests stay at one server while it answers. Another one would begin with paths about which less is known, over
the same networks. A server may be bad although its paths are up: its own network is slow, or it answers nothing. So
after some missed deadlines without any answer, or many without one in time, a late request also goes to another server.
The favourite had a head start, so whoever answers first is better. Under overload no server is better, and the paths to
another one take capacity from those in use. So the time between two tries doubles with each try that is not answered by
its deadline.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from plr.protos.model.ids import NodeName, ServiceName
    from plr.sidecar.core.base.values import PathId
    from plr.sidecar.core.robot.request.mapping_table import MappingTable
    from plr.sidecar.core.robot.request.request import Copy
    from plr.sidecar.core.transfer.routes import Routes

MISSES = 8
"""Another server is tried after so many missed deadlines without any answer: under overload, answers come late ..."""
LATE_MISSES = 40
"""... or after so many without an answer in time."""
FIRST_WAIT_S = 0.25
"""The second try of another server comes this long (s) after the first, which comes at once ..."""
LONGEST_WAIT_S = 8.0
"""... and later ones after at most this time (s)."""


@dataclass(slots=True)
class _Favourite:
    server: NodeName
    chosen: bool = False
    """It took the place of another one, and keeps it although the mapping may not name it."""
    unanswered: int = 0
    """Missed deadlines since its last answer ..."""
    misses: int = 0
    """... and since its last answer in time."""
    next_try_at: float = 0.0
    wait_s: float = FIRST_WAIT_S


class Favourites:
    """The favourite server of each service that shares requests."""

    __slots__ = ("_favourites", "_mapping", "_routes")

    def __init__(self, mapping: MappingTable, routes: Routes) -> None:
        self._mapping = mapping
        self._routes = routes
        self._favourites: dict[ServiceName, _Favourite] = {}

    def choose(
        self, service: ServiceName, servers: Collection[NodeName], mapped: Collection[PathId]
    ) -> NodeName | None:
        """Return a request's server: the favourite if it may be asked and is reached, else the nearest mapped one.

        `mapped`: the paths that the mapping names for it. None: none of their servers is reached.
        """
        favourite = self._favourites.get(service)
        named = {path.peer for path in mapped}
        if (
            favourite is not None
            and favourite.server in servers
            and (favourite.chosen or favourite.server in named)
            and self._mapping.up_to(favourite.server, mapped)
        ):
            return favourite.server
        nearest = self._nearest(named, mapped)
        if nearest is not None:
            self._favourites[service] = _Favourite(nearest)
        return nearest

    def other(
        self, service: ServiceName, than: NodeName, servers: Iterable[NodeName], paths: Collection[PathId]
    ) -> NodeName | None:
        """Return whom to ask in place of another server over the interfaces of these paths; None if none is reached.

        It is the favourite if that is one of them, else the nearest.
        """
        others = [server for server in servers if server != than]
        favourite = self._favourites.get(service)
        if favourite is not None and favourite.server in others and self._mapping.up_to(favourite.server, paths):
            return favourite.server
        return self._nearest(others, paths)

    def _nearest(self, servers: Iterable[NodeName], paths: Collection[PathId]) -> NodeName | None:
        best = [up[0] for server in servers if (up := self._mapping.up_to(server, paths))]
        return min(best, key=self._routes.rtt).peer if best else None

    def missed(self, service: ServiceName, server: NodeName) -> None:
        """Note that a request missed its deadline while it was only at this server, and the path to it is up."""
        favourite = self._favourites.get(service)
        if favourite is not None and favourite.server == server:
            favourite.unanswered += 1
            favourite.misses += 1

    def may_try(self, service: ServiceName, now: float) -> bool:
        """Return whether it is time to find out whether another server is better than the favourite."""
        favourite = self._favourites.get(service)
        if favourite is None or now < favourite.next_try_at:
            return False
        return favourite.unanswered >= MISSES or favourite.misses >= LATE_MISSES

    def tried(self, service: ServiceName, now: float) -> None:
        """Note that a request went to another server as well, or in place of the favourite."""
        favourite = self._favourites[service]
        if now > favourite.next_try_at + LONGEST_WAIT_S:
            favourite.wait_s = FIRST_WAIT_S  # what did not help before may help today
        favourite.next_try_at = now + favourite.wait_s
        favourite.wait_s = min(2.0 * favourite.wait_s, LONGEST_WAIT_S)

    def answered(self, service: ServiceName, copy: Copy, others: Iterable[Copy], deadline_s: float, now: float) -> None:
        """Note which copy of a request was answered first; the `others` are still awaited.

        A server that takes longer than the service's deadline (s) is no better than the favourite.
        """
        favourite = self._favourites.get(service)
        if favourite is None:
            return
        server = copy.path.peer
        if favourite.server == server:
            favourite.unanswered = 0
        if now - copy.sent_at > deadline_s:
            return
        if favourite.server != server and any(
            other.path.peer == favourite.server and other.sent_at < copy.sent_at for other in others
        ):
            self.move(service, server)
        if copy.in_time and favourite.server == server:
            favourite.misses, favourite.next_try_at, favourite.wait_s = 0, 0.0, FIRST_WAIT_S

    def move(self, service: ServiceName, to: NodeName) -> None:
        """Make another server the favourite."""
        before = self._favourites[service]
        self._favourites[service] = _Favourite(to, chosen=True, next_try_at=before.next_try_at, wait_s=before.wait_s)
