"""The paths as the engine knows them: which are up, how fast, and which to take."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from sidecar.core.path_id import PathId, PathState

if TYPE_CHECKING:
    from collections.abc import Iterable

    from protos.model import InterfaceName, NodeName

_RANK = {PathState.UP: 0, PathState.UNSTABLE: 1, PathState.DOWN: 2}


@dataclass(slots=True)
class Route:
    """One path's state as last reported by its link."""

    id: PathId
    state: PathState = PathState.DOWN
    smoothed_rtt_s: float = 0.0

    @property
    def order(self) -> tuple[int, float, PathId]:
        """Sorts the better path first."""
        return (_RANK[self.state], self.smoothed_rtt_s, self.id)


class Routes:
    """All paths to all peers."""

    def __init__(self) -> None:
        self._routes: dict[PathId, Route] = {}
        self._by_peer: dict[NodeName, dict[PathId, Route]] = {}

    def set_state(self, path: PathId, state: PathState) -> None:
        """Note a path's liveness."""
        self._get(path).state = state

    def set_rtt(self, path: PathId, smoothed_rtt_s: float) -> None:
        """Note a path's smoothed round-trip time."""
        self._get(path).smoothed_rtt_s = smoothed_rtt_s

    def _get(self, path: PathId) -> Route:
        route = self._routes.get(path)
        if route is None:
            route = self._routes[path] = Route(path)
            self._by_peer.setdefault(path.peer, {})[path] = route
        return route

    def forget_peer(self, peer: NodeName) -> None:
        """The peer is not to be talked to any more."""
        for path in self._by_peer.pop(peer, {}):
            del self._routes[path]

    def forget_interface(self, interface: InterfaceName) -> list[PathId]:
        """The interface is gone; returns the paths it had."""
        paths = [path for path in self._routes if path.interface == interface]
        for path in paths:
            del self._routes[path]
            del self._by_peer[path.peer][path]
        return paths

    def state(self, path: PathId) -> PathState:
        """Return a path's liveness; unknown paths are down."""
        route = self._routes.get(path)
        return PathState.DOWN if route is None else route.state

    def reaches(self, peer: NodeName) -> bool:
        """Whether any path to the peer is not down."""
        return any(route.state is not PathState.DOWN for route in self._by_peer.get(peer, {}).values())

    def usable(self, peers: Iterable[NodeName]) -> list[Route]:
        """Return the paths to these peers that are not down, best first."""
        routes = (route for peer in peers for route in self._by_peer.get(peer, {}).values())
        return sorted((route for route in routes if route.state is not PathState.DOWN), key=lambda route: route.order)

    def all_to(self, peer: NodeName) -> list[Route]:
        """Return every known path to the peer."""
        return list(self._by_peer.get(peer, {}).values())

    def interfaces_to(self, peer: NodeName) -> list[InterfaceName]:
        """Return our interfaces that have a path to the peer, in order."""
        return sorted({path.interface for path in self._by_peer.get(peer, {})})

    def best_over(self, interface: InterfaceName, peer: NodeName) -> Route | None:
        """Return the best path over this interface to this peer that is not down."""
        routes = [
            route
            for path, route in self._by_peer.get(peer, {}).items()
            if path.interface == interface and route.state is not PathState.DOWN
        ]
        return min(routes, key=lambda route: route.order, default=None)

    def best_to(self, peer: NodeName, avoid: PathId | None = None) -> PathId | None:
        """Return the best path to the peer that is not down; `avoid` is taken only when there is no other."""
        routes = self.usable((peer,))
        for route in routes:
            if route.id != avoid:
                return route.id
        return routes[0].id if routes else None
