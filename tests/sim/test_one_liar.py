"""What one hostile member says: it hides nothing that the others see from the operator, and invents nothing."""

from __future__ import annotations

import pytest

from plr.controlplane.core.control.events import Settings
from plr.controlplane.core.policy.policy import CallRule, OfferRule, Policy
from plr.controlplane.observe.fleet_metrics import families
from plr.protos.model.ids import NodeName, Role
from plr.protos.model.members import RemovalReason, ServiceSet
from plr.protos.model.report import Report
from tests.support.control_world import SETTLED_S, SimSidecar, World
from tests.support.samples import PLAN, offer, path, registration
from tests.support.scrapes import fleet_of, series, value

pytestmark = pytest.mark.audit("ops-12")

ONLY_A_OFFERS = Policy(
    (CallRule(("*",), (PLAN,), ("a", "evil-cloud")),), (OfferRule(("a",), (PLAN,)), OfferRule(("other",), ("*",)))
)


@pytest.mark.parametrize("policy", [None, ONLY_A_OFFERS])
def test_what_a_robot_may_not_call_does_not_serve_it(policy: Policy | None) -> None:
    world = World(Settings(warm_up_s=0.0, policy=policy))
    server = world.cloud("a")
    robot = world.robot()
    world.say(robot, Report(paths=(path("wlan0", "a"),)))
    world.run(SETTLED_S)

    def paths() -> float | None:
        return value(series(families(fleet_of(world))), "plr_robot_service_paths", robot="robot", service=PLAN)

    world.say(server, ServiceSet())
    world.run(SETTLED_S)
    world.say(robot, ServiceSet())
    assert paths() == 0.0, "a glob named it: it is not carried where nobody serves it"
    world.say(world.join(registration("evil")), ServiceSet((offer(),)))
    assert paths() == 0.0, "another robot offers it"
    if policy is not None:
        for name in ("evil-cloud", "other"):
            world.say(world.join(registration(name, Role.CLOUD)), ServiceSet((offer(),)))
        assert paths() == 0.0, "one that may not offer it does, and one that the robot may not call"
    world.say(server, ServiceSet((offer(),)))
    assert paths() is None, "it is served: the robot has another reason"


def test_one_that_claims_to_have_reached_a_server_proves_nothing_against_two() -> None:
    world = World(Settings(warm_up_s=0.0))
    for name in ("fine", "dead", "new"):
        world.cloud(name)
    honest = [world.robot(f"robot-{number}") for number in range(3)]
    liar = world.robot("liar")

    def says(robot: SimSidecar, *up: str) -> None:
        world.say(robot, Report(paths=tuple(path("wlan0", name, up=name in up) for name in ("fine", "dead", "new"))))

    def told(server: str, *paths: str) -> list[float | None]:
        found = series(families(fleet_of(world)))
        return [value(found, "plr_server_robots", server=server, path=path) for path in paths]

    for robot in honest:
        says(robot, "fine", "dead")
        says(robot, "fine")
    assert told("dead", "up", "lost") == [0, 3]
    says(liar, "fine", "dead", "new")
    assert told("dead", "up", "lost") == [1, 3]
    assert told("new", "up", "never") == [1, 3]
    world.leave(liar)
    assert told("new", "up", "never") == [0, 3]
    world.leave(honest[0])
    world.leave(honest[1])
    assert told("new", "never") == [0], "a word against a word"
    world.robot("liar")
    world.core.part_with(NodeName("liar"), RemovalReason.REVOKED, world.now)
    assert told("new", "never") == [1]
