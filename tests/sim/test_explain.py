"""`plr explain`'s answer, out of a control plane that measured and decided."""

from __future__ import annotations

from dataclasses import replace

import pytest

from plr.controlplane.cli.explanation_text import render
from plr.controlplane.core.control.events import Settings
from plr.controlplane.core.explain.explanation import UnknownNameError
from plr.controlplane.core.policy.path_rules import PathRule
from plr.controlplane.core.problem.problem import BlockKey
from plr.protos.model.explanation import AlternativeKind, Correlation, Explanation
from plr.protos.model.ids import InterfaceName, NodeName, Role, ServiceName
from plr.protos.model.mapping import Assignment, ServiceMapping
from plr.protos.model.members import AT_MOST_EVERY_INTERFACE, CandidateSet, InterfaceLabel, ServiceSet
from plr.protos.model.redundancy_mode import RedundancyMode
from plr.protos.model.report import InterfaceJointReport, JointReport, Report
from plr.protos.model.status import SyncState
from tests.support.control_world import SimSidecar, World
from tests.support.samples import PLAN, histogram, interfaces, latency, offer, path, registration, use

ROBOT = NodeName("robot")
WLAN, WWAN = InterfaceName("wlan0"), InterfaceName("wwan0")
LATENCY_S = {("wlan0", "a"): 0.02, ("wlan0", "b"): 0.05, ("wwan0", "a"): 0.04, ("wwan0", "b"): 0.03}


def on(interface: str, server: str) -> Assignment:
    return Assignment(InterfaceName(interface), NodeName(server))


def measured(world: World, robot: SimSidecar, *, seconds: int, misses: dict[tuple[str, str], float]) -> None:
    """Ten full races a second over both paths of each server pairing, of which these shares miss."""
    for elapsed in range(seconds):
        reports = []
        for pair, seconds_ in LATENCY_S.items():
            missed = round(100 * misses.get(pair, 0.0))
            found = histogram(seconds_, times=100 - missed, lost=missed)
            reports.append(latency(*pair, found, processing=histogram(0.01, times=100)))
        first, second = (round(100 * misses.get(pair, 0.0)) for pair in (("wlan0", "a"), ("wwan0", "b")))
        both = min(first, second)
        joint = JointReport(PLAN, on("wlan0", "a"), on("wwan0", "b"), 100, both)
        alone = first - both, second - both
        apart = InterfaceJointReport(PLAN, WLAN, WWAN, None, 100, both, 100, *alone)
        # As an explored copy brings now and then: too few to tell of.
        one = elapsed % 10 == 0
        to_one = InterfaceJointReport(PLAN, WLAN, WWAN, NodeName("a"), one, 0, one, 0, 0)
        probes = tuple(path(*pair, rtt=histogram(seconds_ - 0.015)) for pair, seconds_ in LATENCY_S.items())
        world.say(robot, Report(tuple(reports), probes, joints=(joint,), interface_joints=(apart, to_one)))
        world.run(1.0)


def asked(world: World) -> Explanation:
    return world.core.explain(ROBOT, PLAN, world.now)


@pytest.fixture
def world() -> World:
    world = World()
    world.cloud("a")
    world.cloud("b")
    world.all_up(world.robot(), ("a", "b"))
    world.run(2.0)
    return world


def test_it_tells_what_the_mapping_rests_on(world: World) -> None:
    robot = world.sidecars[ROBOT]
    measured(world, robot, seconds=60, misses={("wlan0", "a"): 0.1, ("wwan0", "b"): 0.1})
    found = asked(world)
    assert found.mapping == robot.services[0]
    assert found.predicted_miss == world.core.plan.blocks[BlockKey(ROBOT, PLAN)].predicted_miss
    assert (found.sync.state, found.sync.version_acked) == (SyncState.SYNCED, robot.mapping_version)
    pairs = {pair.path: pair for pair in found.pairs}
    assert {path for path, pair in pairs.items() if pair.chosen} == set(robot.services[0].assignments)
    assert found.pairs[0].chosen
    worst = pairs[on("wlan0", "a")]
    assert worst.up
    assert worst.miss is not None
    assert worst.miss.low < 0.1 < worst.miss.high
    assert worst.miss.mean == pytest.approx(0.1, rel=0.1)
    assert worst.requests == pytest.approx(100 / (1 - 0.5 ** (1 / 60)) / 2, rel=0.1)
    assert worst.rtt.quantile(0.5) == pytest.approx(0.005, rel=0.03)
    assert worst.compute.quantile(0.99) == pytest.approx(0.01, rel=0.03)
    (joint,) = found.joints
    assert joint.correlation is Correlation.TOGETHER
    assert joint.lift == pytest.approx(10.0, rel=0.05)
    best = next(other for other in found.alternatives if other.kind is AlternativeKind.OTHER)
    assert set(best.assignments) == {on("wlan0", "a"), on("wwan0", "b")}
    assert best.predicted_miss == pytest.approx(0.1, rel=0.2)
    alone = [other for other in found.alternatives if other.kind is AlternativeKind.ALONE]
    assert [other.assignments for other in alone] == [(on("wlan0", "b"),), (on("wwan0", "a"),)]
    without = {other.without: other for other in found.alternatives if other.kind is AlternativeKind.WITHOUT}
    assert without.keys() == {"a", "b"}
    text = render(found)
    assert "wlan0 and wwan0:" in text
    assert "(10 times):" in text
    assert "fail together: a second copy gains little" in text
    assert "capacity for one robot exceeded by 1" in text


@pytest.mark.parametrize("mode", RedundancyMode)
def test_it_tells_how_copies_are_sent(mode: RedundancyMode) -> None:
    world = World()
    world.cloud("a")
    world.cloud("b")
    world.all_up(world.robot(redundancy=mode), ("a", "b"))
    world.run(2.0)
    found = asked(world)
    assert found.redundancy is mode
    assert f"\n  redundancy {mode.value}: " in render(found)


def test_one_streak_of_common_misses_is_not_taken_for_proof_nor_for_nothing(world: World) -> None:
    robot = world.sidecars[ROBOT]
    both = (("wlan0", "a"), ("wwan0", "b"))
    for seconds, share in ((60, 0.0), (5, 1.0), (40, 0.0)):
        measured(world, robot, seconds=seconds, misses=dict.fromkeys(both, share))
    (joint,) = asked(world).joints
    assert joint.correlation is Correlation.LIKELY
    assert "seem to fail together" in render(asked(world))


def test_paths_that_miss_without_each_other_are_not_said_to_fail_together(world: World) -> None:
    measured(world, world.sidecars[ROBOT], seconds=20, misses={("wlan0", "a"): 0.0, ("wwan0", "b"): 0.1})
    (joint,) = asked(world).joints
    assert joint.correlation is Correlation.INDEPENDENT


def test_it_remembers_what_changed_and_why(world: World) -> None:
    robot = world.sidecars[ROBOT]
    measured(world, robot, seconds=10, misses={})
    before = asked(world)
    world.report(robot, path("wlan0", "a", up=False))
    world.run(3.0)
    after = asked(world)
    assert after.changes[0].mapping == robot.services[0]
    assert after.changes[0].age_s <= 3.0
    assert after.in_force_s == pytest.approx(after.changes[0].age_s)
    assert [change.version for change in after.changes[1:]] == [change.version for change in before.changes]
    assert "moved because wlan0 to a is down" in after.changes[0].mapping.reason
    down = next(pair for pair in after.pairs if pair.path == on("wlan0", "a"))
    assert (down.up, down.miss) == (False, None)
    assert after.changes[0].mapping.reason in render(after)


def test_without_a_mapping_it_names_the_live_paths_and_predicts_nothing(world: World) -> None:
    measured(world, world.sidecars[ROBOT], seconds=10, misses={})
    found = replace(asked(world), mapping=ServiceMapping(PLAN, (), 1.0, "no plan yet"))
    section = render(found).split("pairs (")[0]
    assert "the fastest first; it last reported these up: wlan0 -> a, " in section
    assert "reason: no plan yet" in section
    assert "predicted" not in section
    assert "last reported these up" in render(replace(found, mapping=None))


def test_what_paths_share_and_what_they_cost_is_told() -> None:
    world = World()
    for name in ("a", "b"):
        cloud = world.join(replace(registration(name, Role.CLOUD), region="eu"))
        world.say(cloud, CandidateSet(interfaces("eth0")))
        world.say(cloud, ServiceSet((offer(),)))
    robot = world.join(registration("robot"))
    labels = tuple(InterfaceLabel(InterfaceName(nic), "blue", cost) for nic, cost in (("wlan0", 1.0), ("wwan0", 3.0)))
    world.say(robot, CandidateSet(interfaces("wlan0", "wwan0"), labels))
    world.say(robot, ServiceSet((), (replace(use(), target_miss=0.001, copies=AT_MOST_EVERY_INTERFACE),)))
    world.all_up(robot, ("a", "b"))
    world.run(2.0)
    measured(world, robot, seconds=20, misses={("wlan0", "a"): 0.1, ("wwan0", "b"): 0.1})
    found = asked(world)
    assert found.target_miss == 0.001
    assert found.cost_per_request == 1.0
    assert found.mapping is not None
    assert found.mapping.assignments == (on("wlan0", "b"),)
    (joint,) = found.joints
    assert joint.shared == ("carrier blue", "region eu")
    other = next(other for other in found.alternatives if len(other.assignments) == 2)
    assert (other.cost_per_request, other.note) == (4.0, "copies share region eu, carrier blue")
    text = render(found)
    assert "cheapest that misses at most 0.001" in text
    assert "a request costs 1" in text
    assert "wlan0 (blue)" in text


def test_what_is_explored_is_told(world: World) -> None:
    found = asked(world)
    assert found.mapping is not None
    exploring = replace(found, mapping=replace(found.mapping, explore=on("wlan0", "b")))
    assert "explores wlan0 -> b" in render(exploring)
    assert "explores" not in render(replace(found, mapping=replace(found.mapping, explore=None)))


def test_a_pair_that_the_operator_bars_is_said_to_be() -> None:
    rule = PathRule(("*",), ("wlan0",), ("a",), allow=False)
    world = World(Settings(warm_up_s=0.0, path_rules=(rule,)))
    world.cloud("a")
    world.cloud("b")
    world.all_up(world.robot(), ("a", "b"))
    world.run(2.0)
    barred = [pair.path for pair in asked(world).pairs if pair.barred]
    assert barred == [on("wlan0", "a")]
    assert "up, barred" in render(asked(world))


def test_a_service_without_servers_is_explained_too(world: World) -> None:
    for name in ("a", "b"):
        world.leave(world.sidecars[NodeName(name)])
    world.run(2.0)
    found = asked(world)
    assert found.mapping is not None
    assert "no live server" in found.mapping.reason
    assert found.alternatives == ()
    assert "nowhere" in render(found)


@pytest.mark.parametrize(
    ("robot", "service", "told"),
    [
        ("robt", "/plan", "no robot robt is registered; did you mean robot?"),
        ("a", "/plan", "a is a cloud: ask about a robot"),
        ("robot", "/plam", "robot carries no service /plam; did you mean /plan?"),
    ],
)
def test_who_is_not_known_is_told_the_nearest(world: World, robot: str, service: str, told: str) -> None:
    with pytest.raises(UnknownNameError) as caught:
        world.core.explain(NodeName(robot), ServiceName(service), world.now)
    assert str(caught.value) == told


def test_with_nobody_there_none_is_near() -> None:
    with pytest.raises(UnknownNameError, match="no robot robot is registered: there is none"):
        World().core.explain(ROBOT, PLAN, 0.0)
