"""A copy that was refused stays refused, also when it is cut again: its request may be running elsewhere by then."""

from __future__ import annotations

from functools import partial

import pytest

from lab.simulated.mesh import Mesh, rule
from plr.sidecar.core.base.values import RejectReason
from plr.sidecar.core.robot.dispatch.dispatcher import MAX_COPIES_OF_REQUEST, MAX_COPIES_WHILE_REFUSED
from plr.sidecar.core.seam.application import ApplicationEvent, ExecuteRequest, RequestFailed


@pytest.mark.audit("dp-14")
@pytest.mark.parametrize("light_after_s", [0.6, 0.8, 2.0])
def test_a_refused_copy_that_is_cut_again_does_not_run_beside_the_rescue(light_after_s: float) -> None:
    """The request gets to a server that is just being restarted, over a path that dies before it can say so.

    Then another path comes that carries shorter datagrams only: the robot cuts the request again, the refusal crosses
    it on its way, and the server is back.
    """
    mesh = Mesh(1)
    robot = mesh.robot("wlan0", "wwan0", rules=(rule(idempotent=False, deadline_s=2.0, lifetime_s=20.0),))
    near, far = mesh.cloud("cloud-a"), mesh.cloud("cloud-b")
    mesh.push_views()
    for interface, delay_s in (("wlan0", 0.010), ("wwan0", 0.060)):
        for cloud, more_s in ((near, 0.0), (far, 0.02)):
            for wire in mesh.both_ways(f"robot.{interface}", f"{cloud.name}.eth0"):
                wire.delay_s = delay_s + more_s
                wire.mtu = 1280 if interface == "wwan0" else 1500
                wire.cut = interface == "wwan0"
    mesh.run(8.0)

    def light() -> None:
        for wire in mesh.all_wires_of("robot.wwan0"):
            wire.cut = False

    near.engine.cloud.set_offers(())
    for cloud in (near, far):
        mesh.wire(f"{cloud.name}.eth0", "robot.wlan0").cut = True
    robot.submit(bytes(3000))
    mesh.run(0.011)
    assert near.engine.stats.dropped["request_for_unknown_service"] == 1
    for wire in mesh.all_wires_of("robot.wlan0"):
        wire.cut = True
    mesh.at(0.5, lambda: near.engine.cloud.set_offers(near.offers))
    mesh.at(light_after_s, light)
    mesh.run(20.0)
    assert [len(cloud.executed) for cloud in (near, far)] == [0, 1]
    assert len(robot.responses()) == 1


@pytest.mark.audit("dp-7")
@pytest.mark.parametrize("idempotent", [True, False])
@pytest.mark.parametrize("away_s", [3.0, 12.0, 25.0])
def test_a_server_that_takes_long_to_start_is_asked_until_it_is_there(away_s: float, *, idempotent: bool) -> None:
    """The control plane says nothing, so the robot has to ask; it does not do so at every whim of a path."""
    mesh = Mesh(2)
    robot = mesh.robot("wlan0", "wwan0", rules=(rule(idempotent=idempotent, deadline_s=0.5, lifetime_s=60.0),))
    cloud = mesh.cloud("cloud-a")
    mesh.push_views()
    mesh.run(2.0)
    cloud.engine.cloud.set_offers(())
    robot.submit(b"job")
    mesh.at(away_s, lambda: cloud.engine.cloud.set_offers(cloud.offers))
    for second in range(0, int(away_s), 2):
        for cut in (True, False):
            mesh.at(second + (0.1 if cut else 1.1), partial(_cut, mesh, cut=cut))
    mesh.run(60.0)
    assert len(robot.responses()) == 1
    assert len(cloud.executed) == 1
    asked = cloud.engine.stats.dropped["request_for_unknown_service"]
    assert asked <= (MAX_COPIES_OF_REQUEST if away_s < 7.0 else MAX_COPIES_WHILE_REFUSED)


def _cut(mesh: Mesh, *, cut: bool) -> None:
    for wire in mesh.both_ways("robot.wwan0", "cloud-a.eth0"):
        wire.cut = cut


@pytest.mark.audit("dp-7")
@pytest.mark.parametrize("reason", [RejectReason.OVERLOADED, RejectReason.BAD_PAYLOAD, RejectReason.SERVER_LOST])
def test_who_is_refused_waits_for_the_server_that_is_out_of_reach(reason: RejectReason) -> None:
    """One cloud is of no use, and the path to the other one is dark for a moment: the request has the time."""
    mesh = Mesh(3)
    robot = mesh.robot("wlan0", rules=(rule(deadline_s=0.5, lifetime_s=20.0),))
    bad = mesh.cloud("cloud-a")
    mesh.cloud("cloud-b")

    def refuse(event: ApplicationEvent) -> None:
        if isinstance(event, ExecuteRequest):
            bad.engine.cloud.refuse(event.execution, reason, "no", bad.now)

    bad.server = refuse
    mesh.push_views()
    mesh.run(2.0)
    wires = mesh.both_ways("robot.wlan0", "cloud-b.eth0")
    for wire in wires:
        wire.cut = True
    mesh.run(5.0)
    robot.submit(b"job")
    mesh.run(3.0)
    assert not any(isinstance(event, RequestFailed) for event in robot.events)
    for wire in wires:
        wire.cut = False
    mesh.run(1.0)
    assert [response.server for response in robot.responses()] == ["cloud-b"]


@pytest.mark.audit("dp-7")
def test_who_waits_for_a_server_out_of_reach_ends_with_the_reason_of_the_one_that_refused() -> None:
    mesh = Mesh(3)
    robot = mesh.robot("wlan0", rules=(rule(deadline_s=0.5, lifetime_s=4.0),))
    bad = mesh.cloud("cloud-a")
    mesh.cloud("cloud-b")
    bad.server = lambda event: (
        bad.engine.cloud.refuse(event.execution, RejectReason.OVERLOADED, "too much", bad.now)
        if isinstance(event, ExecuteRequest)
        else None
    )
    mesh.push_views()
    for wire in mesh.both_ways("robot.wlan0", "cloud-b.eth0"):
        wire.cut = True
    mesh.run(2.0)
    robot.submit(b"job")
    mesh.run(5.0)
    (failed,) = [event for event in robot.events if isinstance(event, RequestFailed)]
    assert "overloaded: too much" in failed.reason
