"""What befalls a robot as a whole: its host sleeps, and its NATs may have forgotten it meanwhile."""

from __future__ import annotations

import pytest

from sidecar.core.events import RequestFailed
from tests.sim.mesh import rule
from tests.sim.nat import NatMesh
from tests.sim.test_mesh import mapped

pytestmark = pytest.mark.audit("dp-16")


@pytest.mark.parametrize("rebinds", [False, True])
@pytest.mark.parametrize("seconds", [5.0, 60.0, 600.0])
def test_a_robot_that_was_suspended_goes_on_at_once(seconds: float, rebinds: bool) -> None:
    """Its clock stood still, the servers' did not: they believe it gone, and its NATs may have forgotten it."""
    mesh = NatMesh(1)
    robot = mesh.robot("wlan0", "wwan0", rules=(rule(lifetime_s=10.0, deadline_s=0.5),))
    clouds = mesh.cloud("cloud-a"), mesh.cloud("cloud-b")
    mesh.push_views()
    mesh.run(2.0)
    mapped(mesh, robot, ("wlan0", "cloud-a"), ("wwan0", "cloud-b"))
    for _ in range(10):
        robot.submit(bytes(10_000))
        mesh.run(0.1)
    pending = [robot.submit(bytes(10_000)) for _ in range(3)]
    mesh.suspend(robot, seconds)
    if rebinds:
        mesh.rebind("robot.wlan0")
        mesh.rebind("robot.wwan0")
    after = []
    for _ in range(20):
        after.append(robot.submit(bytes(10_000)))
        mesh.run(0.1)
    mesh.run(12.0)
    took = {answer.request_id: answer.elapsed_s for answer in robot.responses()}
    failed = {event.request_id for event in robot.events if isinstance(event, RequestFailed)}
    assert max(took[request] for request in after) < 0.5
    assert all((request in took) != (request in failed) for request in pending)  # none is forgotten
    assert len(took) == len(robot.responses())
    assert all(len(cloud.executed) <= 33 for cloud in clouds)
