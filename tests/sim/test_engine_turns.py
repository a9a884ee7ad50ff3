"""How much the engine does in one go, with thousands of requests in flight: whoever drives it holds its lock so long.

Counted in calls of functions, which no busy machine changes; 25,000 of them take some 3 ms.
"""

from __future__ import annotations

import functools
import sys
from typing import TYPE_CHECKING, Any

import pytest

from lab.simulated.mesh import TYPE, Mesh, Node, rule
from plr.protos.model.ids import InterfaceName, ServiceName, Version
from plr.protos.model.members import PeerSet, RemovalReason, RemovedPeer, ServiceOffer
from plr.protos.model.redundancy_mode import RedundancyMode
from plr.sidecar.core.engine.engine import Engine
from plr.sidecar.core.robot.request_table import RequestTable
from plr.sidecar.core.seam.application import RequestFailed
from plr.sidecar.core.seam.links import SetCarrier

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from types import FrameType

REQUESTS, CLOUDS, SERVICES = 1000, 25, 400
"""What a turn does must not depend on the first of them."""
MAX_CALLS = 25_000
ENTRIES: tuple[tuple[type, str], ...] = (
    *((Engine, name) for name in ("on_link_event", "handle_timer", "apply_peers", "set_interfaces", "take_report")),
    (RequestTable, "submit"),
)

pytestmark = pytest.mark.audit("dp-10")


class Calls:
    """The most function calls that one entry of the robot's engine made."""

    def __init__(self) -> None:
        self.robot: Engine | None = None
        self.most = 0
        self.where = ""
        self._count = 0

    def counting(self, name: str, entry: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(entry)
        def counted(owner: Engine | RequestTable, *args: Any, **options: Any) -> Any:
            if self.robot is None or owner not in (self.robot, self.robot.robot.requests):
                return entry(owner, *args, **options)
            self._count = 0
            sys.setprofile(self._note)
            try:
                return entry(owner, *args, **options)
            finally:
                sys.setprofile(None)
                if self._count > self.most:
                    self.most, self.where = self._count, name

        return counted

    def _note(self, _frame: FrameType, event: str, _argument: object) -> None:
        self._count += event in ("call", "c_call")


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Calls:
    counted = Calls()
    for owner, name in ENTRIES:
        monkeypatch.setattr(owner, name, counted.counting(name, getattr(owner, name)))
    return counted


class World:
    """A robot with two interfaces, many clouds with many services, and many requests that nobody answers yet."""

    def __init__(self, calls: Calls, redundancy: RedundancyMode) -> None:
        self.mesh = Mesh(1)
        self.names = [ServiceName(f"/service_{number}") for number in range(SERVICES)]
        rules = tuple(rule(pattern=name, deadline_s=5.0, lifetime_s=20.0, redundancy=redundancy) for name in self.names)
        self.robot = self.mesh.robot("wlan0", "wwan0", rules=rules)
        self.clouds = [self._cloud(number) for number in range(CLOUDS)]
        calls.robot = self.robot.engine
        self._push_views()
        self.mesh.run(1.0)
        for number in range(REQUESTS):
            self.robot.submit(b"?" * 20, self.names[number % SERVICES])
        self.mesh.run(0.5)

    def _cloud(self, number: int) -> Node:
        cloud = self.mesh.cloud(f"cloud-{number}")
        cloud.server_delay = lambda: None
        cloud.offers = tuple(ServiceOffer(name, TYPE) for name in self.names)
        cloud.engine.cloud.set_offers(cloud.offers)
        return cloud

    def set_carrier(self, *interfaces: str, on: bool) -> None:
        for interface in interfaces:
            self.robot.links[InterfaceName(interface)].execute(SetCarrier(on=on), self.mesh.now)
        self.mesh.pump(self.robot)
        self.mesh.run(0.5)

    def restart_clouds(self) -> None:
        for cloud in self.clouds:
            cloud.alive = False
            cloud.start()
            cloud.engine.cloud.set_offers(cloud.offers)
        self._push_views()
        self.mesh.run(0.5)

    def _push_views(self) -> None:
        for cloud in self.clouds:
            self.robot.own.admit(cloud.as_peer())  # public-key work: the driver does it before it takes the lock
        self.mesh.push_views()

    def lose_interface(self) -> None:
        self.robot.engine.set_interfaces([InterfaceName("wwan0")], self.mesh.now)
        self.mesh.pump(self.robot)
        self.mesh.run(0.5)

    def lose_all_interfaces(self) -> None:
        self.robot.engine.set_interfaces([], self.mesh.now)

    def remove_clouds(self) -> None:
        self.mesh.version += 1
        gone = tuple(RemovedPeer(cloud.name, RemovalReason.LEFT) for cloud in self.clouds)
        version = Version(self.mesh.version)
        assert self.robot.engine.apply_peers(PeerSet(version, version, (), gone), self.mesh.now) is None
        self.mesh.pump(self.robot)
        self.mesh.run(0.1)


@pytest.mark.parametrize("redundancy", [RedundancyMode.REPLICATE, RedundancyMode.BACKUP])
def test_no_event_keeps_the_engine_busy_for_long(calls: Calls, redundancy: RedundancyMode) -> None:
    world = World(calls, redundancy)
    for event in happenings(world):
        assert calls.most <= MAX_CALLS, f"{event}: {calls.most} calls in one {calls.where}"
        calls.most = 0
    failed = [event for event in world.robot.events if isinstance(event, RequestFailed)]
    assert len(failed) == REQUESTS, "each learns of its end"
    assert world.robot.engine.stats.in_flight == 0


def test_losing_all_interfaces_does_not_keep_the_engine_busy_for_long(calls: Calls) -> None:
    """Every path goes, and with each of them services might have lost their last server."""
    world = World(calls, RedundancyMode.REPLICATE)
    calls.most = 0
    world.lose_all_interfaces()
    assert calls.most <= MAX_CALLS, f"{calls.most} calls in one {calls.where}"


def happenings(world: World) -> Iterator[str]:
    yield "registration and requests"
    world.set_carrier("wlan0", on=False)
    yield "one carrier lost"
    world.set_carrier("wlan0", on=True)
    yield "it is back"
    world.set_carrier("wlan0", "wwan0", on=False)
    yield "both carriers lost"
    world.set_carrier("wlan0", "wwan0", on=True)
    yield "both are back"
    world.lose_interface()
    yield "interface gone"
    world.restart_clouds()
    yield "all clouds restart"
    world.mesh.run(5.0)
    yield "all deadlines are over"
    world.robot.engine.take_report(world.mesh.now)
    yield "a report"
    world.remove_clouds()
    yield "all clouds leave"
    world.mesh.run(25.0)
    yield "all services are withdrawn, all requests end"
