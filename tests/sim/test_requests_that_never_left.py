"""What never left the robot has run nowhere: it goes elsewhere, also when it is not idempotent."""

from __future__ import annotations

import pytest

from lab.simulated.mesh import SERVICE, Mesh, Node, rule
from plr.sidecar.core.seam.application import RequestFailed
from plr.sidecar.core.transfer.room import Lane

pytestmark = pytest.mark.audit("dp-7")
BYTES_PER_S = 250_000.0
COUNT = 20


def backlog(size: int = 60_000, lifetime_s: float = 30.0) -> tuple[Mesh, Node, Node, Node, set[bytes]]:
    """Twenty requests wait on one path to the nearer of two clouds; also those of which nothing has left."""
    mesh = Mesh(1)
    robot = mesh.robot("wlan0", rules=(rule(deadline_s=5.0, lifetime_s=lifetime_s, idempotent=False),))
    near, far = mesh.cloud("cloud-a"), mesh.cloud("cloud-b")
    near.answer = far.answer = lambda payload: payload[:4]
    mesh.push_views()
    for cloud, delay_s in ((near, 0.02), (far, 0.03)):
        for wire in mesh.both_ways("robot.wlan0", f"{cloud.name}.eth0"):
            wire.delay_s, wire.bytes_per_s = delay_s, BYTES_PER_S
    mesh.run(1.0)
    for number in range(COUNT):
        robot.submit(number.to_bytes(4, "big") + bytes(size))
    mesh.run(1.0)
    requests = robot.engine.robot.requests._requests.of(SERVICE)
    unsent = {request.id for request in requests if not any(copy.message.symbols.begun for copy in request.copies)}
    assert len(unsent) > COUNT / 2
    return mesh, robot, near, far, set(unsent)


def assert_only_what_left_is_lost(robot: Node, unsent: set[bytes], *clouds: Node) -> None:
    failed = [event for event in robot.events if isinstance(event, RequestFailed)]
    assert not unsent & {event.request_id for event in failed}
    assert len(robot.responses()) == COUNT - len(failed)
    ran = [bytes(request[:4]) for cloud in clouds for request in cloud.executed]  # type: ignore[index]  # payloads
    assert len(ran) == len(set(ran))


def test_when_their_cloud_restarts() -> None:
    mesh, robot, near, far, unsent = backlog()
    ran_before = near.executed
    near.start()
    mesh.push_views()
    mesh.run(30.0)
    near.executed += ran_before
    assert_only_what_left_is_lost(robot, unsent, near, far)


def test_also_when_the_others_have_no_room_for_all_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh, robot, near, far, unsent = backlog()
    ran_before = near.executed
    monkeypatch.setattr("plr.sidecar.core.transfer.room._ROOM_BYTES", dict.fromkeys(Lane, 150_000))
    near.start()
    mesh.push_views()
    mesh.run(0.001)
    assert len(robot.engine.robot.requests._no_room) > COUNT / 3
    mesh.run(30.0)
    near.executed += ran_before
    assert_only_what_left_is_lost(robot, unsent, near, far)


def test_when_no_path_leads_to_their_cloud_any_more() -> None:
    mesh, robot, near, far, unsent = backlog()
    for wire in mesh.all_wires_of(f"{near.name}.eth0"):
        wire.cut = True
    mesh.run(30.0)
    # Until the silence was noticed, some of the others left for nowhere.
    assert len(unsent & {event.request_id for event in robot.responses()}) >= len(unsent) - 4
    assert max(event.elapsed_s for event in robot.responses()) < 15.0
    assert not {bytes(payload) for payload in near.executed} & {bytes(payload) for payload in far.executed}
