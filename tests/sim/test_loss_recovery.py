"""Lost, reordered and doubled datagrams in simulated time: what is lost travels again, over whatever path is best."""

from __future__ import annotations

import pytest

from lab.simulated.mesh import Mesh, Node
from tests.sim.test_mesh import assert_at_most_once, assert_each_answered_once, call_at, mapped

LARGE = 200_000


def one_cloud(seed: int, *, bytes_per_s: float = 5e6) -> tuple[Mesh, Node, Node]:
    """A robot with two interfaces; its requests are mapped to the first of them."""
    mesh = Mesh(seed)
    robot, cloud = mesh.robot("wlan0", "wwan0"), mesh.cloud("cloud-a")
    for interface in ("wlan0", "wwan0"):
        for wire in mesh.both_ways(f"robot.{interface}", "cloud-a.eth0"):
            wire.bytes_per_s = bytes_per_s
    mesh.push_views()
    mesh.run(3.0)
    mapped(mesh, robot, ("wlan0", "cloud-a"))
    return mesh, robot, cloud


def spurious(node: Node) -> int:
    return sum(path.recovery.reordering.spurious for link in node.links.values() for path in link._paths.values())


def lost(node: Node) -> int:
    return sum(path.recovery.total_lost for link in node.links.values() for path in link._paths.values())


@pytest.mark.parametrize("seed", range(5))
def test_what_one_path_loses_the_other_brings_and_both_complete_each_other(seed: int) -> None:
    mesh, robot, cloud = one_cloud(seed)
    call_at(mesh, robot, 20, 1, size=30_000)
    before = {name: mesh.wire(f"robot.{name}", "cloud-a.eth0").carried for name in ("wlan0", "wwan0")}
    robot.submit(bytes(LARGE))
    mesh.run(0.025)
    first, _ = mesh.both_ways("robot.wlan0", "cloud-a.eth0")
    first.cut = True
    came_over_first = first.carried - before["wlan0"]
    assert came_over_first > LARGE / 8, "some of it got through"
    mesh.run(1.5)
    assert_each_answered_once(robot, 21)
    assert_at_most_once(cloud)
    assert mesh.wire("robot.wwan0", "cloud-a.eth0").carried - before["wwan0"] < LARGE, "not all of it travelled twice"


def test_a_lost_message_delays_no_other() -> None:
    mesh, robot, _ = one_cloud(1)
    call_at(mesh, robot, 20, 1)
    first, _ = mesh.both_ways("robot.wlan0", "cloud-a.eth0")
    first.cut = True
    unlucky = robot.submit(b"lost" + bytes(3000))
    first.cut = False
    start = mesh.now
    lucky = robot.submit(b"not lost" + bytes(3000))
    while not any(event.request_id == lucky for event in robot.responses()):
        mesh.run(0.001)
    took = mesh.now - start
    assert took < 2 * first.delay_s + 0.01, "one round trip, as if nothing had been lost before it"
    assert not any(event.request_id == unlucky for event in robot.responses())
    mesh.run(1.0)
    assert_each_answered_once(robot, 22)


@pytest.mark.parametrize("seed", range(8))
def test_reordered_doubled_and_lost_datagrams_lose_no_request(seed: int) -> None:
    mesh, robot, cloud = one_cloud(seed)
    for wire in mesh.wires.values():
        wire.loss, wire.duplicate, wire.jitter_s = 0.05, 0.1, 0.02
    calls = call_at(mesh, robot, 20, 2, size=30_000)
    mesh.run(4.0)
    assert_each_answered_once(robot, calls)
    assert_at_most_once(cloud)
    assert spurious(robot) > 0


def test_a_path_that_only_reorders_is_soon_known_to() -> None:
    mesh, robot, _ = one_cloud(3)
    for wire in mesh.wires.values():
        wire.jitter_s = 0.02
    call_at(mesh, robot, 20, 3, size=30_000)
    early = lost(robot), spurious(robot)
    assert early[1] > 0
    calls = call_at(mesh, robot, 20, 3, size=30_000)
    assert lost(robot) - early[0] < calls * 25 * 0.05, "hardly anything is taken for lost any more"
