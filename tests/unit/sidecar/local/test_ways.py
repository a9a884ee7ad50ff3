"""Tests that the paths shown for a robot's services are those that its requests take."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.protos.model.ids import InterfaceId, InterfaceName, NodeName, ServiceName
from plr.protos.model.mapping import Assignment, ServiceMapping
from plr.sidecar.core.base.values import PathId, PathState
from plr.sidecar.core.path.recent_loss import Recent
from plr.sidecar.core.path.view import PathView
from plr.sidecar.core.robot.robot_role import Destinations
from plr.sidecar.local.ways import ways

if TYPE_CHECKING:
    from collections.abc import Iterable

PLAN, MAP = ServiceName("/plan"), ServiceName("/map")
A, B = NodeName("cloud-a"), NodeName("cloud-b")
WLAN, WWAN = InterfaceName("wlan0"), InterfaceName("wwan0")


def view(interface: InterfaceName, peer: NodeName, rtt_s: float, state: PathState = PathState.UP) -> PathView:
    path = PathId(interface, peer, InterfaceId(0))
    return PathView(path, state, None, 1, rtt_s, 0, 0, 0, Recent(0.0, 0, 0), 1200, 0.0, 0.0, 0.5)


def found(
    views: Iterable[PathView],
    mapped: Iterable[ServiceMapping] = (),
    *,
    servers: tuple[NodeName, ...] = (A, B),
    idempotent: bool = True,
    out_of_favour: frozenset[NodeName] = frozenset(),
) -> list[tuple[InterfaceName, NodeName]]:
    destinations = Destinations({PLAN: (servers, idempotent)}, out_of_favour, frozenset())
    (one,) = ways(destinations, mapped, views)
    assert one.service == PLAN
    return [(path.interface, path.peer) for path in one.paths]


BOTH = [view(WLAN, A, 0.01), view(WLAN, B, 0.02), view(WWAN, A, 0.05), view(WWAN, B, 0.06)]


def mapping(*pairs: tuple[InterfaceName, NodeName]) -> list[ServiceMapping]:
    return [ServiceMapping(PLAN, tuple(Assignment(*pair) for pair in pairs), 1.0, "")]


def test_without_a_mapping_each_interface_takes_its_fastest_live_server() -> None:
    assert found(BOTH) == found(BOTH, mapping()) == [(WLAN, A), (WWAN, B)]


def test_a_mapping_is_followed_while_its_paths_live() -> None:
    assert found(BOTH, mapping((WWAN, A))) == [(WWAN, A)]
    assert found(BOTH[:2], mapping((WWAN, A))) == [(WLAN, A)]


def test_paths_that_are_down_and_servers_of_other_services_are_left_out() -> None:
    down = [view(WLAN, A, 0.01, PathState.DOWN), view(WWAN, B, 0.06)]
    assert found(down) == [(WWAN, B)]
    assert found(down, servers=(A,)) == []


def test_one_server_at_a_time_if_requests_must_not_run_twice() -> None:
    assert found(BOTH, idempotent=False) == [(WLAN, A), (WWAN, A)]


def test_servers_out_of_favour_come_last() -> None:
    assert found(BOTH, out_of_favour=frozenset({A})) == [(WLAN, B), (WWAN, B)]
    assert found(BOTH[::2], out_of_favour=frozenset({A})) == [(WLAN, A), (WWAN, A)]
