"""What one hostile member says: it hides nothing that the others see from the operator, and invents nothing."""

from __future__ import annotations

import pytest

from controlplane.core.control_events import Settings
from controlplane.core.policy import CallRule, OfferRule, Policy
from controlplane.fleet_metrics import families
from protos.model import Report, Role, ServiceSet
from tests.sim.control_world import SETTLED_S, World
from tests.unit.controlplane.samples import PLAN, offer, path, registration
from tests.unit.controlplane.scrapes import fleet_of, series, value

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
