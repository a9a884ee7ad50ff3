"""Sealing between real cores: keys that change under way and restarts that nobody else knows of."""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING

import pytest

from lab.simulated.mesh import Mesh, Node
from lab.simulated.sessions import credential_of
from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import InterfaceId, Version
from plr.protos.model.members import PeerSet
from plr.protos.trust.credential import Aead
from plr.sidecar.core.path.key_exchange import KeyLimits
from plr.sidecar.core.wire import frame
from plr.sidecar.core.wire.introduction import encode_introduction
from tests.sim.test_mesh import assert_each_answered_once

if TYPE_CHECKING:
    from plr.protos.trust.credential import SessionCredential


def pair(seed: int = 1, limits: KeyLimits | None = None) -> tuple[Mesh, Node, Node]:
    mesh = Mesh(seed)
    if limits is not None:
        mesh.key_limits = limits
    robot, cloud = mesh.robot("wlan0", "wwan0"), mesh.cloud("cloud-a")
    mesh.push_views()
    mesh.run(1.0)
    return mesh, robot, cloud


def phases(node: Node) -> list[int]:
    return [path.sealing.phase for link in node.links.values() for path in link._paths.values()]


def dropped(node: Node) -> Counter[str]:
    return sum((link.stats.dropped for link in node.links.values()), start=Counter[str]())


# -- keys that change -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_keys_change_in_the_middle_of_messages_over_a_bad_network_and_nothing_is_lost(seed: int) -> None:
    mesh, robot, cloud = pair(seed, KeyLimits(datagrams=40, seconds=0.5))
    for host in ("robot.wlan0", "robot.wwan0"):
        for wire in mesh.both_ways(host, "cloud-a.eth0"):
            wire.loss, wire.duplicate, wire.jitter_s, wire.bytes_per_s = 0.02, 0.02, 0.01, 2e6
    for number in range(20):
        robot.submit(number.to_bytes(4, "big") + bytes(100_000))
        mesh.run(0.25)
    mesh.run(10.0)
    assert_each_answered_once(robot, 20)
    assert min(phases(robot) + phases(cloud)) > 5
    for node in (robot, cloud):
        assert dropped(node)["unauthentic"] == 0


@pytest.mark.parametrize("slow", ["robot", "cloud-a"])
def test_where_either_is_slow_at_aes_both_use_the_other_cipher(slow: str) -> None:
    mesh = Mesh(1)
    mesh.aeads[slow] = Aead.CHACHA20_POLY1305
    robot, cloud = mesh.robot("wlan0"), mesh.cloud("cloud-a")
    mesh.push_views()
    mesh.run(1.0)
    robot.submit(bytes(50_000))
    mesh.run(1.0)
    assert_each_answered_once(robot, 1)
    for node in (robot, cloud):
        (keys,) = node.engine.peers.for_links()
        assert keys.keys.aead is Aead.CHACHA20_POLY1305


def test_the_keys_of_an_idle_path_change_by_age() -> None:
    mesh, robot, cloud = pair(limits=KeyLimits(seconds=2.0))
    mesh.run(61.0)
    assert min(phases(robot) + phases(cloud)) >= 8, "with its probes, which get rarer"
    assert dropped(robot)["unauthentic"] + dropped(cloud)["unauthentic"] == 0


def test_keys_stay_while_nobody_confirms_them_and_go_on_after_the_outage() -> None:
    mesh, robot, _ = pair(limits=KeyLimits(seconds=1.0))
    for wire in mesh.all_wires_of("robot.wlan0"):
        wire.cut = True
    mesh.run(2.0)
    before = phases(robot)[0]
    mesh.run(30.0)
    assert phases(robot)[0] == before
    for wire in mesh.all_wires_of("robot.wlan0"):
        wire.cut = False
    mesh.run(10.0)
    assert phases(robot)[0] > before


# -- restarts without a control plane ---------------------------------------------------------------------------------


@pytest.mark.parametrize("restarting", [("cloud-a",), ("robot",), ("cloud-a", "robot")])
def test_restarts_are_introduced_and_proven_without_a_control_plane(restarting: tuple[str, ...]) -> None:
    mesh, robot, _ = pair()
    views = {
        name: tuple(other.told_to(node) for other in mesh.nodes.values() if other is not node)
        for name, node in mesh.nodes.items()
    }
    for name in restarting:
        node = mesh.nodes[name]
        node.alive = False
        mesh.run(1.0)
        node.start()
        assert node.engine.apply_peers(PeerSet(Version(1), 1, views[name]), mesh.now) is None  # what its disk remembers
    mesh.run(5.0)
    robot.submit(b"after the restart")
    mesh.run(1.0)
    assert [answer.payload for answer in robot.responses()][-1] == b"echo:after the restart"


def test_a_restart_that_somebody_else_introduces_is_not_believed() -> None:
    """Who knows what the robot introduces itself with (the control plane) says that it restarted, with another key."""
    mesh, robot, cloud = pair()
    forged = credential_of("robot", robot.role, 77, incarnation=robot.incarnation + 10**9)

    def judge(credential: SessionCredential) -> float:
        if credential == forged:
            raise DecodeError("the credential's signature is wrong")
        return math.inf

    cloud.own._verify = judge
    eth0, first = cloud.interfaces[0], InterfaceId(0)
    for number in range(10):
        header = frame.Header(first, first, forged.session, number)
        token = robot.told_to(cloud).token
        data = encode_introduction(header, token, cloud.name, 1, forged.encode())
        mesh.inject(("elsewhere", 666), cloud.address(eth0), data)
        robot.submit(bytes([number]))
        mesh.run(0.05)
    mesh.run(0.1)
    assert_each_answered_once(robot, 10)
    assert cloud.engine.stats.dropped["bad_credential"] == 10
    assert cloud.engine.peers.session(robot.name) == robot.session
