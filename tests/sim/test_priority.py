"""Services of different priority over the same path: bulk never holds up what is urgent."""

from __future__ import annotations

from lab.simulated.mesh import SERVICE, TYPE, Mesh, rule
from plr.protos.model.ids import ServiceName
from plr.protos.model.members import ServiceOffer
from plr.sidecar.core.base.values import Priority
from tests.sim.test_mesh import assert_each_answered_once

BULK = ServiceName("/bulk")


def slowest_urgent_call(bulk: Priority) -> float:
    """Over one path of 4 Mbit/s, 2 MB each way with the earlier deadline; beside it 1 kB of high priority at 20 Hz."""
    mesh = Mesh(3)
    rules = (
        rule(priority=Priority.HIGH, deadline_s=20.0, lifetime_s=60.0),
        rule(pattern=BULK, priority=bulk, deadline_s=10.0, lifetime_s=60.0),
    )
    robot = mesh.robot("wlan0", rules=rules)
    cloud = mesh.cloud("cloud-a")
    cloud.offers = (ServiceOffer(SERVICE, TYPE), ServiceOffer(BULK, TYPE))
    cloud.engine.cloud.set_offers(cloud.offers)
    for wire in mesh.both_ways("robot.wlan0", "cloud-a.eth0"):
        wire.bytes_per_s = 500_000
    mesh.push_views()
    mesh.run(1.0)
    bulk_ids = {robot.submit(bytes(1_000_000), BULK) for _ in range(2)}
    calls = 100
    for _ in range(calls):
        robot.submit(bytes(1000))
        mesh.run(0.05)
    mesh.run(20.0)
    assert_each_answered_once(robot, calls + len(bulk_ids))
    return max(event.elapsed_s for event in robot.responses() if event.request_id not in bulk_ids)


def test_an_urgent_call_waits_for_no_bulk_on_the_way_there_and_back() -> None:
    assert slowest_urgent_call(Priority.LOW) < 0.35, "what stands in the network's queue, never megabytes"
    assert slowest_urgent_call(Priority.HIGH) > 1.0
