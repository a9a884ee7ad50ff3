"""What befalls a robot as a whole: its NATs forget it in the middle of a large message, its host sleeps."""

from __future__ import annotations

import pytest

from lab.simulated.mesh import rule
from plr.protos.model.redundancy_mode import RedundancyMode
from plr.sidecar.core.seam.application import RequestFailed
from tests.sim.nat import NatMesh
from tests.sim.test_mesh import mapped

pytestmark = pytest.mark.audit("dp-16")

BYTES = 6_000_000
RATE = 6.25e6
QUEUE = 1_200_000.0


def transfer_s(*rebinds_s: float) -> float:
    """How long BYTES take both ways over one carrier while its NAT rebinds at these seconds; it runs once."""
    mesh = NatMesh(1)
    robot = mesh.robot("wlan0", rules=(rule(lifetime_s=30.0, deadline_s=10.0),))
    cloud = mesh.cloud("cloud-a")
    cloud.answer = lambda _payload: bytes(BYTES)
    for wire in mesh.both_ways("robot.wlan0", "cloud-a.eth0"):
        wire.bytes_per_s, wire.buffer_bytes, wire.mtu = RATE, QUEUE, 1500
    mesh.push_views()
    mesh.run(3.0)
    mapped(mesh, robot, ("wlan0", "cloud-a"))
    for moment in rebinds_s:
        mesh.at(moment, lambda: mesh.rebind("robot.wlan0"))
    robot.submit(bytes(BYTES))
    mesh.run(6.0)
    answered = robot.responses()
    assert [len(answer.payload) for answer in answered] == [BYTES]
    assert len(cloud.executed) == 1
    assert mesh.refused or not rebinds_s
    return answered[0].elapsed_s


def test_a_nat_that_rebinds_in_the_middle_of_a_large_message_both_ways() -> None:
    undisturbed = transfer_s()
    assert transfer_s(0.5, 1.5, 1.8) < undisturbed + 3 * 0.55


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


@pytest.mark.parametrize(("lifetime_s", "sleeps"), [(10.0, [70.0]), (40.0, [30.0] * 5)])
@pytest.mark.parametrize("mode", RedundancyMode)
def test_a_request_does_not_run_again_at_a_server_that_forgot_it_while_the_robot_was_suspended(
    mode: RedundancyMode, lifetime_s: float, sleeps: list[float]
) -> None:
    mesh = NatMesh(1)
    robot = mesh.robot("wlan0", "wwan0", rules=(rule(lifetime_s=lifetime_s, deadline_s=0.5, redundancy=mode),))
    cloud = mesh.cloud("cloud-a")
    mesh.push_views()
    mesh.run(2.0)
    mapped(mesh, robot, ("wlan0", "cloud-a"), ("wwan0", "cloud-a"))
    for wire in mesh.all_wires_of("robot.wlan0") + mesh.all_wires_of("robot.wwan0"):
        wire.delay_s = 0.1
    request = robot.submit(b"once")
    mesh.run(0.15)
    for seconds in sleeps:
        mesh.suspend(robot, seconds)
    mesh.run(lifetime_s + 1.0)
    assert len(cloud.executed) == 1
    answered = [answer.request_id for answer in robot.responses()]
    failed = [event for event in robot.events if isinstance(event, RequestFailed)]
    assert answered == []
    assert [event.request_id for event in failed] == [request]
    assert "suspended for" in failed[0].reason
