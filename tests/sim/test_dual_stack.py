"""Both ends have two addresses each on the same interface, as IPv4 beside IPv6."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.simulated.mesh import IPV6, Mesh, Node
from plr.sidecar.core.wire.frame import BASE_BYTES

if TYPE_CHECKING:
    from plr.protos.model.ids import Address


def pair(delay_s: float = 0.01) -> tuple[Mesh, Node, Node]:
    mesh = Mesh(seed=1)
    mesh.dual_stack = True
    robot, cloud = mesh.robot("wlan0"), mesh.cloud("a")
    for wire in mesh.both_ways("robot.wlan0", "a.eth0"):
        wire.delay_s = delay_s
    mesh.push_views()
    mesh.run(10.0)
    return mesh, robot, cloud


def remotes(*nodes: Node) -> set[bool]:
    """Whether their paths lead to IPv6 addresses."""
    paths = [path for node in nodes for link in node.links.values() for path in link._paths.values()]
    return {path.remote[0].endswith(IPV6) for path in paths if path.remote is not None}


def disagree(robot: Node, cloud: Node) -> None:
    """As after an outage, when both asked at all addresses and the answers cross."""
    for node, remote in ((robot, ("a.eth0", 1)), (cloud, ("robot.wlan0" + IPV6, 1))):
        for link in node.links.values():
            for path in link._paths.values():
                path.address.move(remote, node.mesh.now)
                path.probing.begin_again(node.mesh.now)


@pytest.mark.parametrize("delay_s", [0.001, 0.1, 0.5])
def test_two_ends_that_use_different_addresses_come_to_one(delay_s: float) -> None:
    mesh, robot, cloud = pair(delay_s)
    disagree(robot, cloud)
    changes = 0
    large = 0

    def look(source: Address, destination: Address, data: bytes) -> None:
        nonlocal large
        large += len(data) > BASE_BYTES

    mesh.tap = look
    before = remotes(robot, cloud)
    for number in range(200):
        robot.submit(number.to_bytes(4, "big"))
        mesh.run(0.05)
        changes += before != (before := remotes(robot, cloud))
    assert len(before) == 1
    assert changes <= 2
    assert large < 20, "each end looks for its size once or twice"


@pytest.mark.parametrize("dead", ["a.eth0", "robot.wlan0"])
def test_an_address_that_nothing_gets_to_any_more_is_left_for_the_other(dead: str) -> None:
    mesh, robot, cloud = pair()
    (ipv6,) = remotes(robot, cloud)
    mesh.unreachable = {dead + (IPV6 if ipv6 else "")}
    for number in range(40):
        robot.submit(number.to_bytes(4, "big"))
        mesh.run(0.1)
    assert remotes(robot, cloud) == {not ipv6}
    assert len(robot.responses()) == 40
