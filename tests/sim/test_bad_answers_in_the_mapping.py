"""A cloud whose answers cannot be delivered leaves the mapping of the robot that met it, and `plr explain` says so."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.simulated.mesh import SERVICE, Mesh, Node, rule
from plr.controlplane.cli.explanation_text import render
from plr.protos.model.ids import Role
from plr.sidecar.core.robot.dispatch.penalties import FIRST_S, LONGEST_S
from tests.sim.joined_planes import JoinedPlanes

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName
    from plr.protos.model.mapping import ServiceMapping

pytestmark = pytest.mark.audit("sec-2")

GARBAGE = b"garbage"


class Fleet:
    """Two robots that carry /echo; to one of them cloud-a answers sooner than cloud-b, and always wrongly."""

    def __init__(self) -> None:
        self.mesh = Mesh(1)
        rules = (rule(deadline_s=0.5, lifetime_s=5.0),)
        self.robot, self.other = (
            self.mesh.add(name, Role.ROBOT, ["wlan0", "wwan0"], rules) for name in ("robot", "other")
        )
        self.clouds = [self.mesh.cloud(name) for name in ("cloud-a", "cloud-b")]
        bad, good = self.clouds
        self.robot.judge = lambda answer: "no such message" if answer == GARBAGE else None
        bad.answer = lambda payload: GARBAGE if payload.startswith(b"robot") else payload
        bad.server_delay, good.server_delay = lambda: 0.001, lambda: 0.03
        self.planes = JoinedPlanes(self.mesh, None)
        self.planes.join(*self.clouds, self.robot, self.other)
        self.planes.run(3.0)

    def call(self, seconds: float) -> None:
        for number in range(int(seconds * 5)):
            for robot in (self.robot, self.other):
                robot.submit(b"%s %d" % (robot.name.encode(), number))
            self.planes.run(0.2)

    def mapping(self, robot: Node) -> ServiceMapping:
        (found,) = robot.engine.service_mappings
        return found

    def servers(self, robot: Node) -> set[NodeName]:
        return {path.server for path in self.mapping(robot).assignments}

    def explained(self, robot: Node) -> str:
        return render(self.planes.core.explain(robot.name, SERVICE, self.mesh.now))


def test_the_mapping_and_plr_explain_say_that_answers_are_bad() -> None:
    fleet = Fleet()
    fleet.call(3.0)
    assert fleet.servers(fleet.robot) == {"cloud-b"}
    assert "answers of cloud-a cannot be delivered" in fleet.mapping(fleet.robot).reason
    text = fleet.explained(fleet.robot)
    assert "up, PENALTY" in text
    assert "servers whose answers cannot be delivered: other servers come first:" in text
    assert "bad answer" in text
    assert "cloud-a" in fleet.servers(fleet.other), "what one robot says moves nobody else"
    assert "PENALTY" not in fleet.explained(fleet.other)
    assert len({event.request_id for event in fleet.robot.responses() if event.payload != GARBAGE}) == 15


def test_a_server_that_was_mended_is_mapped_again() -> None:
    fleet = Fleet()
    fleet.call(3.0)
    fleet.clouds[0].answer = lambda payload: payload
    fleet.call(FIRST_S + 30.0)
    assert "PENALTY" not in fleet.explained(fleet.robot)
    assert "cannot be delivered" not in fleet.mapping(fleet.robot).reason
    for _ in range(int(LONGEST_S / 20)):
        fleet.call(20.0)
        if "cloud-a" in fleet.servers(fleet.robot):
            return
    pytest.fail("it is mapped again within the longest penalty")


def test_the_only_server_stays_mapped() -> None:
    fleet = Fleet()
    fleet.call(3.0)
    fleet.clouds[1].offers = ()
    fleet.clouds[1].engine.cloud.set_offers(())
    fleet.call(60.0)
    assert fleet.servers(fleet.robot) == {"cloud-a"}
    assert "PENALTY" in fleet.explained(fleet.robot)
