"""Requests that no server took yet: they are asked again for as long as their lifetimes last."""

from __future__ import annotations

import pytest

from sidecar.core import room as room_module
from sidecar.core.redundancy_mode import RedundancyMode
from sidecar.core.room import SMALL_BYTES, Lane
from tests.sim.mesh import Mesh, rule

SIZE = 400_000


@pytest.mark.audit("dp-1")
@pytest.mark.parametrize("interfaces", [("wlan0",), ("wlan0", "wwan0")])
def test_a_server_may_be_away_for_nearly_a_whole_lifetime(interfaces: tuple[str, ...]) -> None:
    mesh = Mesh(1)
    robot = mesh.robot(*interfaces, rules=(rule(lifetime_s=30.0),))
    cloud = mesh.cloud("a")
    mesh.push_views()
    mesh.run(2)
    cloud.engine.set_offers(())
    for number in range(5):
        robot.submit(b"%d" % number)
    mesh.run(20)
    cloud.engine.set_offers(cloud.offers)
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
    assert waits in robot.engine._requests._no_room._waiting
    for wire in to_second:
        wire.cut = True
    mesh.run(4)
    robot.submit(b"its end lets the line be looked at")
    mesh.run(2)
    assert waits not in robot.engine._requests._no_room._waiting
    for wire in to_second:
        wire.cut, wire.bytes_per_s = False, 0
    mesh.run(10)
    assert waits in {response.request_id for response in robot.responses()}
