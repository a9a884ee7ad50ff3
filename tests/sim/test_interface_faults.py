"""A carrier that flaps, or is of no use, is told although the other one hides it: both planes, in simulated time."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lab.simulated.mesh import SERVICE, TYPE, Mesh, rule
from plr.controlplane.core.control.events import FaultNotice
from plr.protos.model.ids import Role
from plr.protos.model.members import ServiceOffer
from plr.protos.model.status import Fault
from tests.sim.joined_planes import JoinedPlanes

if TYPE_CHECKING:
    from plr.sidecar.core.base.values import RequestId

PAUSE_S = 0.25
"""Between two requests."""


class Drive:
    """One robot that calls two clouds all the time."""

    def __init__(self) -> None:
        self.mesh = Mesh(1)
        rules = (rule(pattern="/*"),)
        self.robot = self.mesh.add("robot", Role.ROBOT, ["wlan0", "wwan0"], rules)
        clouds = [self.mesh.add(name, Role.CLOUD, ["eth0"], rules) for name in ("a", "b")]
        for cloud in clouds:
            cloud.offers = (ServiceOffer(SERVICE, TYPE),)
            cloud.engine.cloud.set_offers(cloud.offers)
        self.planes = JoinedPlanes(self.mesh, None)
        self.notices: list[FaultNotice] = []
        real = self.planes.core.next_event

        def noticed() -> object:
            event = real()
            if isinstance(event, FaultNotice):
                self.notices.append(event)
            return event

        self.planes.core.next_event = noticed  # type: ignore[assignment,method-assign]
        self.planes.join(*clouds, self.robot)
        self.asked: list[RequestId] = []
        self.planes.run(3.0)

    def go(self, seconds: float) -> None:
        for _ in range(round(seconds / PAUSE_S)):
            self.asked.append(self.robot.submit(b"where", SERVICE))
            self.planes.run(PAUSE_S)

    def cut(self, *nics: str, cut: bool) -> None:
        for interface in self.robot.interfaces:
            if interface in nics:
                for wire in self.mesh.all_wires_of(self.robot.address(interface)[0]):
                    wire.cut = cut

    def told(self) -> list[tuple[str, Fault, bool]]:
        return [(one.found.interface, one.found.fault, one.over) for one in self.notices]

    def answered(self) -> float:
        return len({response.request_id for response in self.robot.responses()}) / len(self.asked)


def test_a_carrier_that_goes_up_and_down_every_few_seconds_is_told() -> None:
    drive = Drive()
    for _ in range(8):
        drive.cut("wwan0", cut=True)
        drive.go(4.0)
        drive.cut("wwan0", cut=False)
        drive.go(4.0)
    assert drive.told() == [("wwan0", Fault.FLAPPING, False)]
    assert drive.answered() > 0.97, "the other one hides it"


def test_a_tunnel_is_not_told() -> None:
    drive = Drive()
    drive.go(10.0)
    drive.cut("wlan0", "wwan0", cut=True)
    drive.go(10.0)
    drive.cut("wlan0", "wwan0", cut=False)
    drive.go(60.0)
    assert drive.told() == []


def test_a_carrier_that_is_up_and_always_too_late_is_told() -> None:
    drive = Drive()
    drive.go(5.0)
    for wire in drive.mesh.all_wires_of(drive.robot.address(drive.robot.interfaces[1])[0]):
        wire.delay_s = 1.5
    drive.go(150.0)
    assert drive.told() == [("wwan0", Fault.USELESS, False)]
    assert drive.answered() > 0.97, "the other one hides it"


def test_a_carrier_that_loses_most_probes_is_told() -> None:
    """Its paths do not stay up for long."""
    drive = Drive()
    drive.go(5.0)
    for wire in drive.mesh.all_wires_of(drive.robot.address(drive.robot.interfaces[1])[0]):
        wire.loss = 0.5
    drive.go(60.0)
    assert drive.told() == [("wwan0", Fault.FLAPPING, False)]
    assert drive.answered() > 0.97, "the other one hides it"
