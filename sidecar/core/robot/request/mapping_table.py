"""Chooses the paths of a request: by the control plane's mapping, and by the sidecar itself where that does not hold.

The mapping says which interface goes to which server (paper, section IV.A). If a path dies between two mappings, the
interface takes another live server. With no mapping at all (or none of its paths alive) the sidecar assigns by
round-trip time itself. A request never waits for the control plane.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.protos.model.ids import Version
from plr.sidecar.core.base.values import PathState

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping

    from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
    from plr.protos.model.mapping import MappingSet, ServiceMapping
    from plr.sidecar.core.base.values import PathId
    from plr.sidecar.core.transfer.routes import Route, Routes


class MappingTable:
    """The mapping in force and the choice of paths."""

    def __init__(self, routes: Routes, services: Iterable[ServiceMapping] = ()) -> None:
        """Begin with the mapping of these services, by default of none."""
        self._routes = routes
        self._services: dict[ServiceName, ServiceMapping] = {one.service: one for one in services}
        self.version = Version(0)

    @property
    def services(self) -> Mapping[ServiceName, ServiceMapping]:
        """Return the mapping in force."""
        return self._services

    def apply(
        self, mapping: MappingSet, interfaces: Collection[InterfaceName], servers: Collection[NodeName]
    ) -> str | None:
        """Put a mapping in force. Return None, or what is wrong with it, in which case the old one stays."""
        for service in mapping.services:
            for assignment in (*service.assignments, *((service.explore,) if service.explore else ())):
                if assignment.interface not in interfaces:
                    return f"{service.service}: no interface {assignment.interface!r} here"
                if assignment.server not in servers:
                    return f"{service.service}: no peer {assignment.server!r} known here"
        self._services = {service.service: service for service in mapping.services}
        self.version = mapping.version
        return None

    def choose(self, service: ServiceName, servers: Collection[NodeName], *, idempotent: bool) -> tuple[PathId, ...]:
        """Return the paths for a new request's copies; empty when no path reaches any of the `servers`.

        `servers` are the live ones that offer the service. Requests that are not idempotent get one server only,
        over every interface that reaches it: the server runs them once (`executions.py`).
        """
        chosen = self._mapped(service, servers)
        if not any(route.state is PathState.UP for route in chosen):
            chosen = self._merge(chosen, self._by_round_trip_time(servers))
        if not idempotent:
            chosen = self._over_every_interface(chosen)
        return tuple(route.id for route in chosen)

    def _mapped(self, service: ServiceName, servers: Collection[NodeName]) -> list[Route]:
        mapping = self._services.get(service)
        chosen: list[Route] = []
        for assignment in mapping.assignments if mapping else ():
            route = None
            if assignment.server in servers:
                route = self._routes.best_over(assignment.interface, assignment.server)
            if route is None:
                others = [other for other in self._routes.usable(servers) if other.id.interface == assignment.interface]
                route = others[0] if others else None
            if route is not None and route not in chosen:
                chosen.append(route)
        return chosen

    def _by_round_trip_time(self, servers: Collection[NodeName]) -> list[Route]:
        """Give each interface its fastest server, a different one from the other interfaces' if possible."""
        chosen: dict[InterfaceName, Route] = {}
        taken: set[NodeName] = set()
        routes = self._routes.usable(servers)
        for fresh_server_only in (True, False):
            for route in routes:
                if route.id.interface not in chosen and not (fresh_server_only and route.id.peer in taken):
                    chosen[route.id.interface] = route
                    taken.add(route.id.peer)
        return list(chosen.values())

    def _merge(self, first: list[Route], more: list[Route]) -> list[Route]:
        return first + [route for route in more if route not in first]

    def _over_every_interface(self, routes: list[Route]) -> list[Route]:
        """Keep one server, and reach it over each of the interfaces in `routes`."""
        if not routes:
            return routes
        server = next((route for route in routes if route.state is PathState.UP), routes[0]).id.peer
        return self._to(server, (route.id for route in routes))

    def _to(self, server: NodeName, paths: Iterable[PathId]) -> list[Route]:
        interfaces = dict.fromkeys(path.interface for path in paths)
        over = (self._routes.best_over(interface, server) for interface in interfaces)
        return [route for route in over if route is not None]

    def up_to(self, server: NodeName, paths: Iterable[PathId]) -> list[PathId]:
        """Return the paths to one server that are up, over the interfaces of these paths, the fastest first."""
        routes = [route for route in self._to(server, paths) if route.state is PathState.UP]
        return [route.id for route in sorted(routes, key=lambda route: route.order)]

    def rescue(self, servers: Collection[NodeName]) -> PathId | None:
        """Return the best path that is up to any of these servers, for a request whose copies are in trouble."""
        routes = self._routes.usable(servers)
        return routes[0].id if routes and routes[0].state is PathState.UP else None
