"""Finds over which paths a robot's requests would go right now, with the code that chooses them for a request.

It works on a copy of the paths' states, so that no request waits for it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from plr.sidecar.core.robot.request.mapping_table import MappingTable
from plr.sidecar.core.transfer.routes import Routes

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from plr.protos.model.ids import ServiceName
    from plr.protos.model.mapping import ServiceMapping
    from plr.sidecar.core.base.values import PathId
    from plr.sidecar.core.path.view import PathView
    from plr.sidecar.core.robot.robot_role import Destinations


class Ways(NamedTuple):
    """The paths of one service."""

    service: ServiceName
    paths: tuple[PathId, ...]
    """None of them is down; empty if no server of the service is reached."""


def ways(destinations: Destinations, mapped: Iterable[ServiceMapping], views: Iterable[PathView]) -> Iterator[Ways]:
    """Yield for each service offered on the robot the paths from which its redundancy mode takes those of a request."""
    routes = Routes()
    for view in views:
        routes.set_state(view.id, view.state)
        routes.set_rtt(view.id, view.smoothed_rtt_s)
    table = MappingTable(routes, mapped)
    for name, (servers, idempotent) in sorted(destinations.services.items()):
        reached = [server for server in servers if routes.reaches(server)]
        favoured = [server for server in reached if server not in destinations.out_of_favour] or reached
        yield Ways(name, table.choose(name, favoured, idempotent=idempotent))
