"""Requests that no server took yet: they are asked again for as long as their lifetimes last."""

from __future__ import annotations

import pytest

from lab.simulated.mesh import TYPE, Mesh, rule
from plr.protos.model.ids import Role, ServiceName
from plr.protos.model.members import ServiceOffer
from plr.protos.model.redundancy_mode import RedundancyMode
from plr.sidecar.core.base.values import Priority
from plr.sidecar.core.transfer import room as room_module
from plr.sidecar.core.transfer.room import SMALL_BYTES, Lane

SIZE = 400_000


@pytest.mark.audit("dp-1")
@pytest.mark.parametrize("interfaces", [("wlan0",), ("wlan0", "wwan0")])
def test_a_server_may_be_away_for_nearly_a_whole_lifetime(interfaces: tuple[str, ...]) -> None:
    mesh = Mesh(1)
    robot = mesh.robot(*interfaces, rules=(rule(lifetime_s=30.0),))
    cloud = mesh.cloud("a")
    mesh.push_views()
    mesh.run(2)
    cloud.engine.cloud.set_offers(())
    for number in range(5):
        robot.submit(b"%d" % number)
    mesh.run(20)
    cloud.engine.cloud.set_offers(cloud.offers)
    mesh.run(5)
    assert len(robot.responses()) == 5
    assert len(cloud.executed) == 5


@pytest.mark.audit("dp-1")
@pytest.mark.parametrize("idempotent", [True, False])
def test_what_waited_for_room_at_a_server_that_went_dark_is_sent_when_it_is_back(
    monkeypatch: pytest.MonkeyPatch, *, idempotent: bool
) -> None:
    assert SIZE > SMALL_BYTES
    monkeypatch.setitem(room_module._ROOM_BYTES, Lane.LARGE, 3 * SIZE + 1000)
    mesh = Mesh(1)
    rules = (rule(lifetime_s=60.0, deadline_s=5.0, idempotent=idempotent, redundancy=RedundancyMode.SINGLE),)
    robot = mesh.robot("wlan0", rules=rules)
    first = mesh.cloud("a")
    mesh.cloud("b")
    to_first, to_second = (mesh.both_ways("robot.wlan0", f"{name}.eth0") for name in ("a", "b"))
    mesh.push_views()
    mesh.run(2)
    for wire in to_first:
        wire.cut = True
    mesh.run(3)
    to_second[0].bytes_per_s = 1e5
    for number in range(3):
        robot.submit(bytes((number,)) * (SIZE - 1000))
    for wire in to_first:
        wire.cut = False
    mesh.run(2)
    first.engine.drain()
    waits = robot.submit(bytes(SIZE - 1000))
    mesh.run(1)
    assert waits in robot.engine.robot.requests._no_room._waiting
    for wire in to_second:
        wire.cut = True
    mesh.run(4)
    robot.submit(b"its end lets the line be looked at")
    mesh.run(2)
    assert waits not in robot.engine.robot.requests._no_room._waiting
    for wire in to_second:
        wire.cut, wire.bytes_per_s = False, 0
    mesh.run(10)
    assert waits in {response.request_id for response in robot.responses()}


@pytest.mark.audit("dp-1")
def test_what_misses_its_deadline_does_not_take_the_room_of_what_is_next(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(room_module._ROOM_BYTES, Lane.LARGE, 1_300_000)
    bulk, urgent = ServiceName("/bulk"), ServiceName("/urgent")
    rules = (
        rule(pattern=bulk, lifetime_s=60.0, deadline_s=50.0, priority=Priority.LOW),
        rule(pattern=urgent, lifetime_s=60.0, deadline_s=2.0, priority=Priority.HIGH),
    )
    mesh = Mesh(1)
    robot = mesh.robot("wlan0", rules=rules)
    cloud = mesh.add("a", Role.CLOUD, ["eth0"], rules)
    cloud.offers = (ServiceOffer(bulk, TYPE), ServiceOffer(urgent, TYPE))
    cloud.engine.cloud.set_offers(cloud.offers)
    mesh.wire("robot.wlan0", "a.eth0").bytes_per_s = 2e6
    mesh.push_views()
    mesh.run(2)
    for _ in range(4):
        robot.submit(bytes(300_000), urgent)
    waits = robot.submit(bytes(700_000), bulk)
    for _ in range(100):
        for _ in range(2):
            robot.submit(bytes(300_000), urgent)
        mesh.run(0.1)
    request = robot.engine.robot.requests._requests.get(waits)
    assert request is None or request.copies
