"""Who is gone is remembered, with why and what was known last."""

from __future__ import annotations

from dataclasses import replace

import pytest

from plr.controlplane.cli.explanation_text import render
from plr.controlplane.core.control.events import Settings
from plr.controlplane.core.explain.departed import MAX_DEPARTED, MAX_EXPLAINED, Departed, Departure
from plr.controlplane.core.explain.explanation import UnknownNameError
from plr.controlplane.core.policy.policy import CallRule, OfferRule, Policy
from plr.protos.model.fleet_events import Why
from plr.protos.model.ids import NodeName, Role
from plr.protos.model.members import RemovalReason
from plr.protos.model.report import OutcomeReport, Report
from plr.protos.model.stream import Drain
from tests.support.control_world import SETTLED_S, SimSidecar, World
from tests.support.samples import PLAN, histogram, latency, path

pytestmark = pytest.mark.audit("ops-11")

ROBOT = NodeName("robot")


def why(world: World) -> dict[str, Why]:
    return {gone.name: gone.why for gone in world.core.departed}


def carrying(world: World) -> SimSidecar:
    """A robot that has measured its paths to two clouds."""
    world.cloud("a")
    world.cloud("b")
    robot = world.robot()
    world.run(SETTLED_S)
    for _ in range(4):
        times = histogram(0.03, times=25)
        pairs = [(nic, server) for nic in ("wlan0", "wwan0") for server in ("a", "b")]
        world.say(
            robot,
            Report(
                paths=tuple(path(nic, server, rtt=histogram(0.02, times=5)) for nic, server in pairs),
                latencies=tuple(latency(nic, server, times) for nic, server in pairs),
                outcomes=(OutcomeReport(PLAN, ok=20),),
            ),
        )
        world.run(0.5)
    world.run(SETTLED_S)
    return robot


def test_a_silent_member_is_gone_with_the_time_it_was_seen_last(world: World) -> None:
    robot = world.robot()
    world.run(SETTLED_S)
    robot.silent = True
    seen = world.now
    world.run(world.settings.lease_s + 60.0)
    (told,) = world.core.departed.told(world.now, 10)
    assert (told.name, told.role, told.why) == (ROBOT, Role.ROBOT, Why.LEASE_EXPIRED)
    assert told.seen_s == pytest.approx(world.now - seen, abs=world.settings.lease_s)
    assert told.seen_s - told.gone_s == pytest.approx(world.settings.lease_s, abs=0.1)
    assert told.services == (PLAN,)


def test_each_way_to_go_has_its_reason(world: World) -> None:
    names = ("drained", "left", "revoked", "expired")
    members = {name: world.cloud(name) for name in names}
    world.run(SETTLED_S)
    world.leave(members["drained"])
    world.say(members["left"], Drain())
    members["left"].silent = True
    world.core.part_with(NodeName("revoked"), RemovalReason.REVOKED, world.now)
    world.core.part_with(NodeName("expired"), RemovalReason.EXPIRED, world.now)
    world.dispatch()
    world.run(world.settings.lease_s + SETTLED_S)
    assert why(world) == {
        "drained": Why.DRAINED,
        "left": Why.LEFT,
        "revoked": Why.REVOKED,
        "expired": Why.CERTIFICATE_EXPIRED,
    }


def test_who_is_back_is_not_gone(world: World) -> None:
    robot = world.robot()
    world.leave(robot)
    assert why(world) == {"robot": Why.DRAINED}
    world.robot()
    assert why(world) == {}


def test_whom_the_policy_cuts_off_is_as_good_as_gone() -> None:
    def policy(*robots: str) -> Policy:
        return Policy((CallRule(robots, (PLAN,), ("*",)),), (OfferRule(("*",), (PLAN,)),))

    world = World(Settings(warm_up_s=0.0, policy=policy("robot-1", "robot-2")))
    world.cloud("a")
    for name in ("robot-1", "robot-2"):
        world.robot(name)
    world.run(SETTLED_S)
    world.core.set_policy(policy("robot-1"), world.now)
    assert why(world) == {"robot-2": Why.POLICY}
    world.core.set_policy(policy(), world.now)
    assert why(world) == {"robot-1": Why.POLICY, "robot-2": Why.POLICY, "a": Why.POLICY}
    world.core.set_policy(None, world.now)
    assert why(world) == {}


def test_the_last_mapping_of_a_robot_that_is_gone_is_explained(world: World) -> None:
    robot = carrying(world)
    before = world.core.explain(ROBOT, PLAN, world.now)
    robot.silent = True
    world.run(world.settings.lease_s + 600.0)
    assert world.core.registry.get(ROBOT) is None
    found = world.core.explain(ROBOT, PLAN, world.now)
    assert found.gone_why is Why.LEASE_EXPIRED
    assert found.gone_s == pytest.approx(600.0, abs=world.settings.lease_s + 1.0)
    assert found.mapping == before.mapping
    assert found.predicted_miss is not None
    assert {pair.path for pair in found.pairs} == {pair.path for pair in before.pairs}
    assert [pair.up for pair in found.pairs] == [True] * 4
    # Ten half-lives later: what it measured has not faded, as nothing came that could replace it.
    assert all(pair.requests > 50.0 for pair in found.pairs)
    assert all(10.0 < pair.probes < 20.0 for pair in found.pairs)
    assert [pair.rtt.quantile(0.5) for pair in found.pairs] == pytest.approx([0.02] * 4, rel=0.03)
    assert found.alternatives
    assert f"{ROBOT} IS GONE for the control plane for 10 min (lease_expired)" in render(found)
    assert f"{ROBOT} IS GONE for 10 min (revoked)" in render(replace(found, gone_why=Why.REVOKED))


def test_a_service_that_a_robot_never_carried_is_not_explained(world: World) -> None:
    robot = carrying(world)
    world.leave(robot)
    with pytest.raises(UnknownNameError, match="did you mean /plan"):
        world.core.explain(ROBOT, type(PLAN)("/plam"), world.now)


def departure(name: str) -> Departure:
    return Departure(NodeName(name), Role.ROBOT, Why.LEASE_EXPIRED, 1.0, 0.0)


def test_one_that_comes_and_goes_pushes_out_nobody() -> None:
    departed = Departed()
    for number in range(MAX_DEPARTED):
        departed.note(departure(f"robot-{number}"))
    for _ in range(10):
        departed.note(departure("robot-7"))
    assert len(departed) == MAX_DEPARTED
    assert departed.forgotten == 0
    departed.note(departure("one-more"))
    assert departed.get(NodeName("robot-0")) is None
    assert departed.forgotten == 1


def test_only_the_last_ones_can_be_explained(world: World) -> None:
    robot = carrying(world)
    world.leave(robot)
    last = world.core.departed.last_known(ROBOT)
    assert last is not None
    for number in range(MAX_EXPLAINED):
        world.core.departed.note(departure(f"robot-{number}"), last)
    with pytest.raises(UnknownNameError, match="plr events --node robot"):
        world.core.explain(ROBOT, PLAN, world.now)


def test_a_server_that_was_stopped_while_the_control_plane_was_away_is_no_dead_one() -> None:
    """By what robots say, before it is given up or after that."""
    world = World(Settings(warm_up_s=5.0))
    present = [replace(departure(name), role=Role.CLOUD) for name in ("soon", "late", "dead", "back")]
    world.core.remember([], [*present, departure("robot")], world.now)
    robot = world.robot()
    world.say(robot, Report(goodbyes=tuple(NodeName(name) for name in ("soon", "back", "stranger"))))
    world.cloud("back")
    world.run(5.0 + world.settings.lease_s + 1.0)
    assert why(world) == {"soon": Why.DRAINED, "late": Why.LEASE_EXPIRED, "dead": Why.LEASE_EXPIRED}
    for _ in range(2):
        world.say(robot, Report(goodbyes=(NodeName("late"),)))
    assert why(world) == {"soon": Why.DRAINED, "late": Why.DRAINED, "dead": Why.LEASE_EXPIRED}
    assert world.departed == ["soon", "late", "dead", "late"]


@pytest.mark.audit("ops-16")
def test_a_robot_says_who_was_stopped_of_servers_alone_and_of_those_that_it_may_call() -> None:
    policy = Policy((CallRule(("robot",), ("*",), ("mine",)),), (OfferRule(("*",), ("*",)),))
    world = World(Settings(warm_up_s=5.0, policy=policy))
    servers = [replace(departure(name), role=Role.CLOUD) for name in ("mine", "others", "late")]
    world.core.remember([], [*servers, departure("arm")], world.now)
    robot = world.robot()
    world.say(robot, Report(goodbyes=tuple(NodeName(name) for name in ("mine", "others", "arm"))))
    world.run(5.0 + world.settings.lease_s + 1.0)
    world.say(robot, Report(goodbyes=(NodeName("late"),)))
    assert {name for name, reason in why(world).items() if reason is Why.DRAINED} == {"mine"}
    assert set(why(world)) == {"mine", "others", "late", "arm"}
    assert world.core.counters.report_entries_forbidden == 3


@pytest.mark.audit("ops-16")
def test_one_robot_of_several_hides_no_dead_server_and_two_are_believed() -> None:
    world = World(Settings(warm_up_s=5.0))
    world.core.remember([], [replace(departure(name), role=Role.CLOUD) for name in ("soon", "late")], world.now)
    liar, other = world.robot(), world.robot("other")
    for _ in range(3):
        world.say(liar, Report(goodbyes=(NodeName("soon"), NodeName("late"))))
    world.say(other, Report(goodbyes=(NodeName("soon"),)))
    world.run(5.0 + world.settings.lease_s + 1.0)
    assert why(world) == {"soon": Why.DRAINED, "late": Why.LEASE_EXPIRED}
    texts = {str(gone.name): gone.text for gone in world.core.departed}
    assert texts["soon"] == "robot, other reported that it said goodbye while the control plane was away"
    assert texts["late"].endswith("did not come back; only robot reported that it said goodbye")
    world.say(liar, Report(goodbyes=(NodeName("late"),)))
    assert why(world)["late"] is Why.LEASE_EXPIRED
    world.say(other, Report(goodbyes=(NodeName("late"),)))
    assert why(world)["late"] is Why.DRAINED
    assert world.departed == ["soon", "late", "late"]


def test_no_robot_says_of_others_that_they_were_stopped(world: World) -> None:
    """Of those that the control plane itself has seen go it knows better."""
    robot = world.robot()
    server = world.cloud("a")
    world.run(SETTLED_S)
    server.silent = True
    world.run(world.settings.lease_s + 1.0)
    world.say(robot, Report(goodbyes=(NodeName("a"),)))
    assert why(world) == {"a": Why.LEASE_EXPIRED}


def test_who_does_not_come_back_after_a_restart_is_gone() -> None:
    world = World(Settings(warm_up_s=5.0))
    present = [departure("robot"), departure("a"), departure("lost")]
    world.core.remember([departure("long-gone")], present, world.now)
    world.cloud("a")
    world.robot()
    world.run(5.0 + world.settings.lease_s + 1.0)
    assert set(why(world)) == {"long-gone", "lost"}
    assert world.departed == ["lost"]
    gone = world.core.departed.get(NodeName("lost"))
    assert gone is not None
    assert "before the control plane was restarted" in gone.text
