"""The loss that a path shows is that of its last minute, in simulated time."""

from __future__ import annotations

from lab.simulated.mesh import Mesh, Node
from tests.sim.test_mesh import call_at


def shown(node: Node, now: float) -> float:
    (view,) = [view for link in node.links.values() for view in link.views(now)]
    return view.recent.lost / view.recent.sent


def test_a_bad_minute_is_forgotten_and_a_new_one_seen() -> None:
    mesh = Mesh(1)
    robot = mesh.robot("wlan0")
    mesh.cloud("cloud-a")
    mesh.push_views()
    mesh.run(3.0)
    there, _ = mesh.both_ways("robot.wlan0", "cloud-a.eth0")

    def minutes(count: int, loss: float) -> None:
        there.loss = loss
        call_at(mesh, robot, 5, 60.0 * count)

    minutes(1, 0.3)
    assert 0.2 < shown(robot, mesh.now) < 0.4
    minutes(2, 0.0)
    assert shown(robot, mesh.now) < 0.01
    minutes(1, 0.3)
    assert 0.2 < shown(robot, mesh.now) < 0.4
