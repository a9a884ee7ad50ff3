"""What waits at a cloud for its server until the cloud's own patience is over: the robot learns that it has not run."""

from __future__ import annotations

import pytest

from lab.simulated.mesh import Mesh, rule
from plr.protos.model.ids import Role
from plr.protos.model.redundancy_mode import RedundancyMode
from tests.sim.serial_server import SerialServer


@pytest.mark.audit("dp-10")
def test_requests_that_their_server_never_got_run_elsewhere() -> None:
    mesh = Mesh(1)
    rules = (rule(lifetime_s=30.0, deadline_s=20.0, idempotent=False, redundancy=RedundancyMode.SINGLE),)
    robot = mesh.robot("wlan0", rules=rules)
    slow = mesh.add("a", Role.CLOUD, ["eth0"], (rule(lifetime_s=5.0),))
    server = SerialServer(mesh, slow, busy_s=100.0)
    other = mesh.cloud("b")
    slow.offers = other.offers
    slow.engine.cloud.set_offers(slow.offers)
    wires = mesh.both_ways("robot.wlan0", "b.eth0")
    mesh.push_views()
    for wire in wires:
        wire.cut = True
    mesh.run(2)
    for number in range(20):
        robot.submit(bytes((number,)) * 20)
    mesh.run(1)
    for wire in wires:
        wire.cut = False
    mesh.run(2)
    held = server.window.waiting
    assert held > 0
    assert not other.executed
    mesh.run(8)
    assert len(other.executed) == held
    assert len(robot.responses()) == held
