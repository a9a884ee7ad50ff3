"""A member introduces another one to a third party: what it was told about that one is of no use there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.simulated.mesh import Mesh, rule
from plr.protos.model.ids import InterfaceId, InterfaceName, NodeName, Role
from plr.sidecar.core.wire.frame import Header
from plr.sidecar.core.wire.introduction import encode_introduction
from tests.sim.joined_planes import JoinedPlanes

if TYPE_CHECKING:
    from lab.simulated.mesh import Node
    from plr.protos.model.ids import Address
    from plr.protos.model.members import Peer, PeerSet

pytestmark = pytest.mark.audit("sec-5")

WLAN = InterfaceName("wlan0")
VICTIM: Address = ("victim", 53)
PHANTOMS = range(10, 42)
INTRODUCTIONS = 2 * len(PHANTOMS)


def fleet() -> tuple[Mesh, JoinedPlanes, Node, Node, Node]:
    """Two robots, the second of which is hostile, and a cloud, which the control plane joined."""
    mesh = Mesh(1)
    robot, evil = mesh.robot("wlan0"), mesh.add("evil", Role.ROBOT, ["wlan0"], (rule(),))
    cloud = mesh.cloud("cloud-a")
    planes = JoinedPlanes(mesh, None)
    planes.join(robot, evil, cloud)
    planes.run(5.0)
    mesh.unreachable.add(VICTIM[0])
    return mesh, planes, robot, evil, cloud


def told(planes: JoinedPlanes, node: Node, of: Node) -> Peer:
    """What the control plane told a sidecar of another one."""
    (peer,) = (peer for peer in planes.peer_sets[node.name].peers if peer.name == of.name)
    return peer


def introduce(mesh: Mesh, of: Peer, to: Node) -> list[bytes]:
    """Introduce phantom interfaces from the victim's address; returns what it is sent within 10 minutes."""
    sent: list[bytes] = []
    mesh.tap = lambda source, destination, data: sent.append(data) if destination[0] == VICTIM[0] else None
    for number in PHANTOMS:
        for packet in range(2):
            header = Header(InterfaceId(number), InterfaceId(0), of.session, 5 + packet)
            forged = encode_introduction(header, of.token, to.name, 7, of.credential)
            mesh.inject(VICTIM, to.address(WLAN), forged)
            mesh.run(0.001)
    mesh.run(600.0)
    mesh.tap = None
    return sent


def test_a_robot_cannot_introduce_a_cloud_to_another_robot() -> None:
    """Before: 32 paths were begun, and the victim was sent 18,738 introductions."""
    mesh, planes, robot, evil, cloud = fleet()
    table = robot.links[WLAN]._table
    paths = set(table.paths)
    assert introduce(mesh, told(planes, evil, cloud), robot) == []
    assert set(table.paths) == paths
    assert table.stats.dropped["unknown_introducer"] == INTRODUCTIONS
    robot.submit(b"as before")
    mesh.run(1.0)
    assert len(robot.responses()) == 1


def test_nobody_is_told_the_same_as_another_nor_what_a_sidecar_registered_with() -> None:
    _, planes, robot, evil, cloud = fleet()
    tokens = [
        told(planes, robot, cloud),
        told(planes, evil, cloud),
        told(planes, cloud, robot),
        told(planes, cloud, evil),
    ]
    assert len({peer.token for peer in tokens} | {node.token for node in (robot, evil, cloud)}) == 7


def test_it_introduces_itself_after_a_restart_by_what_the_other_was_told() -> None:
    """Both ends derive the same, also with a control plane that is away."""
    mesh, planes, robot, _, cloud = fleet()
    view: PeerSet = planes.peer_sets[robot.name]
    robot.alive = False
    mesh.run(1.0)
    robot.start()
    assert robot.engine.apply_peers(view, robot.now) is None
    mesh.run(3.0)
    robot.submit(b"introduced")
    mesh.run(1.0)
    assert len(robot.responses()) == 1
    assert cloud.engine.peers.session(NodeName("robot")) == robot.session
