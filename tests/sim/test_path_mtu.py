"""Path MTU in simulated time: found per path, followed when it shrinks, and no request lost by it."""

from __future__ import annotations

from functools import partial

import pytest

from lab.simulated.mesh import Mesh, Node, rule
from plr.protos.model.ids import InterfaceName, NodeName
from plr.sidecar.core.path.pmtu import RETRY_S
from plr.sidecar.core.seam.links import SetMtu
from plr.sidecar.core.wire.frame import BASE_BYTES, MAX_DATAGRAM_BYTES
from tests.sim.test_mesh import assert_at_most_once, assert_each_answered_once, call_at, mapped

CLOUD = NodeName("cloud-a")


def set_mtu(mesh: Mesh, interface: str, mtu: int) -> None:
    for wire in mesh.all_wires_of(f"robot.{interface}"):
        wire.mtu = mtu


def two_paths(
    seed: int, mtus: dict[str, int], *clouds: str, interface_mtu: int = 1500, **rule_changes: object
) -> tuple[Mesh, Node, list[Node]]:
    """A robot whose two interfaces, and the networks behind them, have these MTUs."""
    mesh = Mesh(seed)
    robot = mesh.robot(*mtus, rules=(rule(**rule_changes),))
    servers = [mesh.cloud(name) for name in clouds]
    for node in mesh.nodes.values():
        for link in node.links.values():
            link.execute(SetMtu(interface_mtu), mesh.now)
    for interface, mtu in mtus.items():
        set_mtu(mesh, interface, mtu)
    mesh.push_views()
    mesh.run(10.0)
    return mesh, robot, servers


def found(robot: Node, interface: str) -> int:
    return max(
        route.max_datagram
        for route in robot.engine.routes.all_to(CLOUD)
        if route.id.interface == InterfaceName(interface)
    )


def test_each_path_finds_its_own() -> None:
    _, robot, _ = two_paths(1, {"wlan0": 9000, "wwan0": 1400}, "cloud-a", interface_mtu=9000)
    assert found(robot, "wlan0") == MAX_DATAGRAM_BYTES
    assert found(robot, "wwan0") == 1372


@pytest.mark.parametrize("mtu", [BASE_BYTES + 28, 1280, 1400, 1500, 9000])
def test_a_path_of_any_mtu_carries_everything(mtu: int) -> None:
    mtus = {"wlan0": mtu, "wwan0": mtu}
    mesh, robot, clouds = two_paths(2, mtus, "cloud-a", "cloud-b", interface_mtu=9000)
    mapped(mesh, robot, ("wlan0", "cloud-a"), ("wwan0", "cloud-b"))
    calls = call_at(mesh, robot, 10, 5, size=20_000)
    mesh.run(5.0)
    assert_each_answered_once(robot, calls)
    assert_at_most_once(*clouds)
    assert found(robot, "wlan0") <= mtu - 28
    assert found(robot, "wlan0") > BASE_BYTES or mtu == BASE_BYTES + 28


def test_longer_datagrams_are_fewer() -> None:
    sent = {}
    for mtu in (1280, 9000):
        mesh, robot, _ = two_paths(3, {"wlan0": mtu, "wwan0": mtu}, "cloud-a", interface_mtu=mtu)
        before = data_sent(robot)
        call_at(mesh, robot, 10, 2, size=100_000)
        sent[mtu] = data_sent(robot) - before
    assert sent[9000] < sent[1280] / 5


def data_sent(robot: Node) -> int:
    return sum(link.stats.datagrams["sent", "data"] for link in robot.links.values())


def test_the_mtu_shrinks_in_the_middle_of_transfers() -> None:
    mtus = {"wlan0": 1500, "wwan0": 1500}
    mesh, robot, clouds = two_paths(4, mtus, "cloud-a", "cloud-b", deadline_s=5.0, lifetime_s=30.0)
    assert found(robot, "wlan0") == found(robot, "wwan0") == 1472
    mapped(mesh, robot, ("wlan0", "cloud-a"), ("wwan0", "cloud-b"))
    for interface in mtus:
        mesh.at(0.505, partial(set_mtu, mesh, interface, 1300))
    calls = call_at(mesh, robot, 20, 3, size=100_000)
    mesh.run(5.0)
    assert_each_answered_once(robot, calls)
    assert_at_most_once(*clouds)
    assert max(event.elapsed_s for event in robot.responses()) < 2.0
    mesh.run(RETRY_S + 10)
    assert found(robot, "wlan0") == found(robot, "wwan0") == 1252


def test_two_paths_of_different_mtu_to_one_peer_complete_each_other() -> None:
    mesh, robot, clouds = two_paths(5, {"wlan0": 1500, "wwan0": 1300}, "cloud-a")
    for wire in mesh.all_wires_of("robot.wlan0"):
        wire.loss = 0.2
    calls = call_at(mesh, robot, 10, 5, size=50_000)
    mesh.run(5.0)
    assert_each_answered_once(robot, calls)
    assert_at_most_once(*clouds)


def test_what_was_cut_for_a_path_that_dies_is_cut_again_for_the_one_that_takes_over() -> None:
    mesh, robot, clouds = two_paths(6, {"wlan0": 1500, "wwan0": 1280}, "cloud-a")
    cut(mesh, "wwan0")
    mesh.run(5.0)

    def swap() -> None:
        cut(mesh, "wwan0", cut=False)
        cut(mesh, "wlan0")

    mesh.at(1.005, swap)
    calls = call_at(mesh, robot, 20, 3, size=50_000)
    mesh.run(5.0)
    assert_each_answered_once(robot, calls)
    assert_at_most_once(*clouds)


def cut(mesh: Mesh, interface: str, *, cut: bool = True) -> None:
    for wire in mesh.all_wires_of(f"robot.{interface}"):
        wire.cut = cut


def test_random_loss_does_not_shrink_it() -> None:
    mesh, robot, _ = two_paths(7, {"wlan0": 1500, "wwan0": 1500}, "cloud-a")
    for wire in mesh.wires.values():
        wire.loss = 0.05
    call_at(mesh, robot, 20, 20, size=20_000)
    paths = [path for node in mesh.nodes.values() for link in node.links.values() for path in link._paths.values()]
    assert all(path.mtu._holes == 0 for path in paths)
