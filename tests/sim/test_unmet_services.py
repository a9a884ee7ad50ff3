"""A configured service that nobody serves, or whose type is missing, is told to the operator by its right name."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from plr.controlplane.cli.status_table import render
from plr.controlplane.core.control.events import UnmetNotice
from plr.controlplane.core.explain.explanation import UnknownNameError
from plr.controlplane.core.policy.policy import CallRule, OfferRule, Policy
from plr.protos.model.ids import NodeName, ServiceName
from plr.protos.model.members import ServiceSet
from tests.support.control_world import SETTLED_S, World
from tests.support.samples import offer, use

if TYPE_CHECKING:
    from plr.controlplane.core.control.events import Event

pytestmark = pytest.mark.audit("ops-5")

WRONG = ServiceName("/plam")
PLAN = ServiceName("/plan")


def events(world: World) -> list[Event]:
    found = []
    while (event := world.core.next_event()) is not None:
        found.append(event)
    return found


def test_it_stands_in_the_status_with_the_name_that_was_meant() -> None:
    world = World()
    world.cloud("a")
    robot = world.robot()
    world.say(robot, ServiceSet((), (use(),), (WRONG,)))
    world.run(SETTLED_S)
    statuses = world.core.status(world.now)
    assert [status.unmet for status in statuses] == [(), (WRONG,)]
    assert "UNMET /plam: configured, but no server that it knows offers it; did you mean /plan?" in render(statuses)


def test_a_cloud_did_not_mean_what_it_offers() -> None:
    world = World()
    cloud = world.cloud("a")
    world.say(cloud, ServiceSet((offer(),), (), (WRONG,)))
    shown = render(world.core.status(world.now))
    assert "UNMET /plam: configured, but no node there offers it, or none that can be called" in shown
    assert "did you mean" not in shown


def test_explain_suggests_the_name_that_was_meant() -> None:
    world = World()
    world.cloud("a")
    robot = world.robot()
    world.say(robot, ServiceSet((), (), (WRONG,)))
    with pytest.raises(UnknownNameError, match=r"configured to carry /plam.*did you mean /plan\?"):
        world.core.explain(NodeName("robot"), WRONG, world.now)


def test_a_service_whose_servers_are_not_reached_is_told_so_and_blames_no_name() -> None:
    world = World()
    world.cloud("a")
    world.cloud("b")
    robot = world.robot()
    world.say(robot, ServiceSet(unreached=(PLAN,)))
    world.run(SETTLED_S)
    shown = render(world.core.status(world.now))
    assert "UNREACHED /plan: servers that it knows offer it, but it reaches none of them" in shown
    assert "UNMET" not in shown
    assert not [event for event in events(world) if isinstance(event, UnmetNotice)]
    text = r"^robot carries no /plan: 2 clouds offer it, but the robot reaches none of them; plr status robot shows"
    with pytest.raises(UnknownNameError, match=text):
        world.core.explain(NodeName("robot"), PLAN, world.now)


@pytest.mark.parametrize("told", [ServiceSet(), ServiceSet(unmet=(PLAN,))], ids=["not_configured", "unmet"])
@pytest.mark.parametrize("calls", ["/plan", "/other"], ids=["allowed", "forbidden"])
def test_explain_never_suggests_the_very_name(told: ServiceSet, calls: str) -> None:
    world = World()
    world.core.set_policy(Policy((CallRule(("*",), (calls,), ("*",)),), (OfferRule(("*",), ("*",)),)), world.now)
    world.say(world.cloud("a"), ServiceSet((offer(), offer("/other"))))
    robot = world.robot()
    world.say(robot, told)
    with pytest.raises(UnknownNameError) as refused:
        world.core.explain(NodeName("robot"), PLAN, world.now)
    assert "did you mean" not in str(refused.value)
    assert ("the policy denies" in str(refused.value)) == (calls != "/plan")


def test_a_type_that_is_not_installed_is_told_and_blames_no_name() -> None:
    world = World()
    cloud = world.cloud("a")
    robot = world.robot()
    untyped = ServiceName("/mark")
    world.say(cloud, ServiceSet((offer(), offer("/mark")), untyped=(ServiceName("/arm"),)))
    world.say(robot, ServiceSet((), (use(),), untyped=(untyped,)))
    world.run(SETTLED_S)
    shown = render(world.core.status(world.now))
    assert "UNTYPED /mark: not carried: its service type is not installed there" in shown
    assert "UNTYPED /arm: not offered: its service type is not installed there" in shown
    with pytest.raises(UnknownNameError, match=r"^robot cannot carry /mark: its service type is not installed there"):
        world.core.explain(NodeName("robot"), untyped, world.now)


def test_it_is_told_once_and_is_no_news_to_others() -> None:
    world = World()
    cloud = world.cloud("a")
    robot = world.robot()
    world.run(SETTLED_S)
    sets, solvings = len(cloud.peer_sets), world.solvings
    assert robot.stream is not None
    for _ in range(2):
        world.core.receive(robot.stream, ServiceSet((), (use(),), (WRONG,)), world.now)
    assert events(world) == [UnmetNotice(robot.name, (WRONG,))]
    world.run(SETTLED_S)
    assert (len(cloud.peer_sets), world.solvings) == (sets, solvings)
