"""Tracks the paths as the engine knows them: which are up, how fast, and which to take."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from operator import attrgetter
from typing import TYPE_CHECKING

from plr.sidecar.core.base.values import PathId, PathState
from plr.sidecar.core.message.repair import Loss, LossEstimate
from plr.sidecar.core.wire.frame import BASE_BYTES, FRAGMENT_OVERHEAD_BYTES

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from plr.protos.model.ids import InterfaceName, NodeName

_order = attrgetter("order")
_RANK = {PathState.UP: 0, PathState.UNSTABLE: 1, PathState.DOWN: 2}


@dataclass(slots=True)
class Route:
    """One path's state as last reported by its link."""

    id: PathId
    state: PathState = PathState.DOWN
    smoothed_rtt_s: float = 0.0
    max_datagram: int = BASE_BYTES
    """Bytes of UDP payload."""
    estimate: LossEstimate = field(default_factory=LossEstimate)
    order: tuple[int, float, PathId] = field(init=False)
    """Sort key, better paths first. It is precomputed, as every request asks for it on every path."""

    def __post_init__(self) -> None:
        self._set_order()

    def set_state(self, state: PathState) -> None:
        """Note its liveness."""
        self.state = state
        if state is PathState.DOWN:
            self.max_datagram = BASE_BYTES
        self._set_order()

    def set_rtt(self, smoothed_rtt_s: float) -> None:
        """Note its smoothed round-trip time."""
        self.smoothed_rtt_s = smoothed_rtt_s
        self._set_order()

    def _set_order(self) -> None:
        self.order = (_RANK[self.state], self.smoothed_rtt_s, self.id)


class Routes:
    """All paths to all peers."""

    def __init__(self) -> None:
        self._routes: dict[PathId, Route] = {}
        self._by_peer: dict[NodeName, dict[PathId, Route]] = {}
        self._reached: set[NodeName] = set()
        self._counts: dict[InterfaceName, Counter[PathState]] = {}
        self.best: Mapping[InterfaceName, PathState] = {}
        """The best path state over each of our interfaces with paths; replaced by a new object on each change."""

    def set_state(self, path: PathId, state: PathState) -> None:
        """Note a path's liveness."""
        route = self._get(path)
        self._count(path, route.state, state)
        route.set_state(state)
        self._look_whether_reached(path.peer)

    def _look_whether_reached(self, peer: NodeName) -> None:
        if any(route.state is not PathState.DOWN for route in self._by_peer.get(peer, {}).values()):
            self._reached.add(peer)
        else:
            self._reached.discard(peer)

    def set_max_datagram(self, path: PathId, size: int) -> None:
        """Note the longest datagram of a path, in bytes of UDP payload."""
        self._get(path).max_datagram = size

    def set_rtt(self, path: PathId, smoothed_rtt_s: float) -> None:
        """Note a path's smoothed round-trip time."""
        self._get(path).set_rtt(smoothed_rtt_s)

    def rtt(self, path: PathId) -> float:
        """Return a path's smoothed round-trip time in seconds, 0 while unknown."""
        route = self._routes.get(path)
        return 0.0 if route is None else route.smoothed_rtt_s

    def note_fates(self, path: PathId, arrived: int, missed: int, *, policed: bool = False) -> None:
        """Note how many of a path's datagrams arrived and were missed since the last call.

        `policed`: past losses say nothing of what the path loses from now on.
        """
        route = self._get(path)
        if policed:
            route.estimate = LossEstimate()
        else:
            route.estimate.add(arrived, missed)

    def loss(self, path: PathId) -> Loss:
        """Return the loss to expect of the path."""
        route = self._routes.get(path)
        return Loss() if route is None else route.estimate.loss

    def _get(self, path: PathId) -> Route:
        route = self._routes.get(path)
        if route is None:
            route = self._routes[path] = Route(path)
            self._by_peer.setdefault(path.peer, {})[path] = route
            self._count(path, None, route.state)
        return route

    def _count(self, path: PathId, before: PathState | None, after: PathState | None) -> None:
        """Count a path's change of state; None: there is no such path."""
        interface = path.interface
        counts = self._counts.setdefault(interface, Counter())
        if before is not None:
            counts[before] -= 1
        if after is not None:
            counts[after] += 1
        best = next((state for state in _RANK if counts[state]), None)
        if best is not self.best.get(interface):
            others = {name: state for name, state in self.best.items() if name != interface}
            self.best = others if best is None else others | {interface: best}

    def forget_peer(self, peer: NodeName) -> None:
        """Forget a peer that is no longer to be talked to."""
        for path in self._by_peer.pop(peer, {}):
            self._count(path, self._routes.pop(path).state, None)
        self._reached.discard(peer)

    def forget_interface(self, interface: InterfaceName) -> list[PathId]:
        """Forget an interface that is gone; return its paths."""
        paths = [path for path in self._routes if path.interface == interface]
        for path in paths:
            self._count(path, self._routes.pop(path).state, None)
            del self._by_peer[path.peer][path]
            self._look_whether_reached(path.peer)
        return paths

    def state(self, path: PathId) -> PathState:
        """Return a path's liveness; unknown paths are down."""
        route = self._routes.get(path)
        return PathState.DOWN if route is None else route.state

    def best_state(self, paths: Iterable[PathId]) -> PathState:
        """Return the liveness of the best of these paths."""
        return min((self.state(path) for path in paths), key=_RANK.__getitem__, default=PathState.DOWN)

    def reaches(self, peer: NodeName) -> bool:
        """Return whether any path to the peer is not down."""
        return peer in self._reached

    def reached(self) -> list[NodeName]:
        """Return the peers with a path that is not down."""
        return list(self._reached)

    def reaches_any(self, peers: Iterable[NodeName]) -> bool:
        """Return whether any path to any of these peers is not down."""
        return not self._reached.isdisjoint(peers)

    def dark(self, peers: Iterable[NodeName]) -> tuple[InterfaceName, ...]:
        """Return our interfaces with paths to these peers of which none is up."""
        up: dict[InterfaceName, bool] = {}
        for peer in peers:
            for path, route in self._by_peer.get(peer, {}).items():
                up[path.interface] = up.get(path.interface, False) or route.state is PathState.UP
        return tuple(interface for interface, lit in up.items() if not lit)

    def usable(self, peers: Iterable[NodeName]) -> list[Route]:
        """Return the paths to these peers that are not down, best first."""
        return sorted(
            (
                route
                for peer in peers
                if peer in self._reached
                for route in self._by_peer[peer].values()
                if route.state is not PathState.DOWN
            ),
            key=_order,
        )

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
        return min(routes, key=_order, default=None)

    def best_to(self, peer: NodeName, avoid: PathId | None = None, size: int = 0) -> PathId | None:
        """Return the best path to the peer that is not down, preferably one that carries datagrams of `size` bytes.

        `avoid` is taken only if there is no other, or if it is up and the others carry less than `size`.
        """

        def reluctance(route: Route) -> int:
            suspect = route.id == avoid
            if route.max_datagram < size:
                return 4 if suspect else 2
            if suspect:
                return 1 if route.state is PathState.UP else 3
            return 0

        routes = self.usable((peer,))
        best = min(routes, key=lambda route: (reluctance(route), route.order), default=None)
        return None if best is None else best.id

    def beside(self, path: PathId, size: int) -> PathId | None:
        """Return the best other path to the same peer that is up, carries `size` bytes and is not much slower."""
        slowest = 2.0 * self._get(path).smoothed_rtt_s
        others = [
            route
            for route in self.all_to(path.peer)
            if route.id != path
            and route.state is PathState.UP
            and route.max_datagram >= size
            and route.smoothed_rtt_s <= slowest
        ]
        best = min(others, key=_order, default=None)
        return None if best is None else best.id

    def max_datagram(self, path: PathId) -> int:
        """Return the longest datagram of the path, in bytes of UDP payload."""
        route = self._routes.get(path)
        return BASE_BYTES if route is None else route.max_datagram

    def symbol_to(self, peer: NodeName) -> int:
        """Return the symbol size (bytes) that every path to the peer carries, except those that are down."""
        routes = self._by_peer.get(peer, {}).values()
        sizes = (route.max_datagram for route in routes if route.state is not PathState.DOWN)
        return min(sizes, default=BASE_BYTES) - FRAGMENT_OVERHEAD_BYTES
