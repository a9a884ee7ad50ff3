"""The core as a whole, with simulated sidecars in simulated time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from plr.controlplane.core.publish.publisher import INFORM_S
from plr.protos.model.ids import NodeName, Version
from plr.protos.model.members import ServiceSet
from plr.protos.model.report import OutcomeReport, Report
from plr.protos.model.status import SyncState
from plr.protos.model.stream import Heartbeat
from tests.support.control_world import SETTLED_S
from tests.support.samples import PLAN, histogram, interfaces, latency, offer, path, use

if TYPE_CHECKING:
    from tests.support.control_world import World

ROBOT = NodeName("robot")


def test_robots_see_clouds_and_clouds_see_robots(world: World) -> None:
    a, b, robot = world.cloud("a"), world.cloud("b"), world.robot()
    other = world.robot("robot-2")
    world.run(SETTLED_S)
    assert robot.peer_names == other.peer_names == {"a", "b"}
    assert a.peer_names == b.peer_names == {"robot", "robot-2"}
    assert robot.welcomes[0].lease_s == world.settings.lease_s
    assert robot.peers[0].offers == (offer(),)
    assert a.peers[0].candidates == interfaces("wlan0", "wwan0")


def test_two_interfaces_and_two_servers_get_one_each(world: World) -> None:
    world.cloud("a"), world.cloud("b")
    robot = world.robot()
    world.run(SETTLED_S)
    world.all_up(robot, ("a", "b"))
    world.run(SETTLED_S)
    assert sorted(robot.pairs()) == ["wlan0", "wwan0"]
    assert sorted(robot.pairs().values()) == ["a", "b"]
    world.run(INFORM_S)
    assert robot.reason() == "least probability that all copies miss"


def test_a_mapping_comes_before_any_path_is_known_to_be_up(world: World) -> None:
    world.cloud("a"), world.cloud("b")
    robot = world.robot()
    world.run(0.2)
    assert sorted(robot.pairs()) == ["wlan0", "wwan0"]
    assert "all known pairs" in robot.reason()


def test_measurements_move_the_mapping(world: World) -> None:
    world.cloud("a"), world.cloud("b")
    robot = world.robot()
    up = [path(nic, server) for nic in ("wlan0", "wwan0") for server in ("a", "b")]
    measured = {("wlan0", "a"): 0.2, ("wlan0", "b"): 0.02, ("wwan0", "a"): 0.02, ("wwan0", "b"): 0.2}
    latencies = tuple(latency(nic, server, histogram(s, times=200)) for (nic, server), s in measured.items())
    world.say(robot, Report(latencies=latencies, paths=tuple(up)))
    world.run(SETTLED_S)
    assert robot.pairs() == {"wlan0": "b", "wwan0": "a"}
    predicted = robot.services[0].predicted_miss
    assert predicted < 1e-4
    view = world.core.view(ROBOT, world.now)
    assert view is not None
    assert view.misses[0].predicted == pytest.approx(predicted)


def test_a_path_that_dies_moves_the_mapping_at_once(world: World) -> None:
    world.cloud("a"), world.cloud("b"), world.cloud("c")
    robot = world.robot()
    world.all_up(robot, ("a", "b"))
    world.run(SETTLED_S)
    dead = robot.pairs()["wlan0"]
    live = {"a": "b", "b": "a"}[dead]
    world.report(robot, path("wlan0", dead, up=False), path("wlan0", live), path("wlan0", "c"))
    world.run(0.1)
    assert robot.pairs()["wlan0"] != dead


def test_a_dark_interface_stays_on_standby_where_it_was(world: World) -> None:
    world.cloud("a"), world.cloud("b")
    robot = world.robot()
    world.all_up(robot, ("a", "b"))
    world.run(SETTLED_S)
    before = robot.pairs()
    world.report(robot, path("wwan0", "a", up=False), path("wwan0", "b", up=False))
    world.run(INFORM_S)
    assert robot.pairs()["wwan0"] == before["wwan0"]
    assert "no path is up over wwan0" in robot.reason()
    assert robot.services[0].predicted_miss == pytest.approx(0.5)


def test_what_merely_reads_differently_is_told_once_in_a_while(world: World) -> None:
    """Each first report changes what is predicted; the robot does the same all the while."""
    world.cloud("a"), world.cloud("b")
    robot = world.robot()
    for _ in range(int(10 * INFORM_S)):
        world.all_up(robot, ("a", "b"))
        world.run(0.1)
    first = robot.pairs()
    readings = {(mapping.reason, mapping.predicted_miss) for told in robot.mapping_sets for mapping in told.services}
    assert first == robot.pairs()
    assert len(readings) <= 4
    assert len(robot.mapping_sets) <= 4


def test_what_is_not_idempotent_goes_to_one_server(world: World) -> None:
    world.cloud("a"), world.cloud("b")
    robot = world.robot(idempotent=False)
    world.all_up(robot, ("a", "b"))
    world.run(SETTLED_S)
    assert len(robot.pairs()) == 2
    assert len(set(robot.pairs().values())) == 1


def test_too_few_servers_are_shared_and_it_says_so(world: World) -> None:
    world.cloud("a")
    robot = world.robot()
    world.all_up(robot, ("a",))
    world.run(SETTLED_S)
    assert robot.pairs() == {"wlan0": "a", "wwan0": "a"}
    assert "capacity exceeded by 1" in robot.reason()
    assert world.core.plan.relaxed == 1
    assert world.core.counters.relaxations == 1


def test_a_capacity_over_all_robots_is_kept_to_and_its_excess_told(world: World) -> None:
    world.cloud("a", capacity=1), world.cloud("b", capacity=1)
    one, two = world.robot("one", "wlan0"), world.robot("two", "wlan0")
    for robot in (one, two):
        world.all_up(robot, ("a", "b"), "wlan0")
    world.run(SETTLED_S)
    assert {one.pairs()["wlan0"], two.pairs()["wlan0"]} == {"a", "b"}
    three = world.robot("three", "wlan0")
    world.all_up(three, ("a", "b"), "wlan0")
    world.run(SETTLED_S)
    assert world.core.plan.relaxed == 1
    assert "for all robots" in three.reason()


def test_without_a_server_the_mapping_is_empty_and_says_why(world: World) -> None:
    robot = world.robot()
    world.run(SETTLED_S)
    assert robot.pairs() == {}
    assert "no live server" in robot.reason()
    assert robot.services[0].predicted_miss == 1.0


def test_reports_of_clouds_are_ignored(world: World) -> None:
    a = world.cloud("a")
    world.say(a, Report(outcomes=(OutcomeReport(PLAN, ok=5),)))
    assert world.core.counters.reports_ignored == 1
    assert world.core.counters.reports == 0


def test_observed_misses_stand_beside_the_predicted(world: World) -> None:
    world.cloud("a")
    robot = world.robot()
    world.say(robot, Report(outcomes=(OutcomeReport(PLAN, ok=90, deadline_missed=10),)))
    world.run(SETTLED_S)
    view = world.core.view(ROBOT, world.now)
    assert view is not None
    assert view.misses[0].observed == pytest.approx(0.1)


def test_reports_alone_solve_once_a_second_and_push_nothing_new(world: World) -> None:
    world.cloud("a"), world.cloud("b")
    robot = world.robot()
    world.all_up(robot, ("a", "b"))
    world.run(5.0)
    solvings, pushed = world.solvings, len(robot.mapping_sets)
    for _ in range(20):
        world.all_up(robot, ("a", "b"))
        world.run(0.5)
    assert world.solvings - solvings <= 11
    assert len(robot.mapping_sets) == pushed


def test_a_failed_solving_leaves_the_plan_and_is_tried_again(world: World) -> None:
    world.cloud("a")
    robot = world.robot()
    world.run(SETTLED_S)
    before = robot.pairs()
    world.all_up(robot, ("a",))
    world.now += 0.1
    assert world.core.start_solving(world.now) is not None
    assert world.core.start_solving(world.now) is None
    world.core.solving_failed(world.now)
    assert robot.pairs() == before
    solvings = world.solvings
    world.run(SETTLED_S)
    assert world.solvings == solvings + 1
    world.run(INFORM_S)
    assert "no path is up" not in robot.reason()


def test_a_service_no_longer_used_leaves_the_mapping(world: World) -> None:
    world.cloud("a")
    robot = world.robot()
    world.run(SETTLED_S)
    assert robot.services
    world.say(robot, ServiceSet((), (use("/other"),)))
    world.run(SETTLED_S)
    assert [mapping.service for mapping in robot.services] == ["/other"]


def test_status_shows_everything_but_the_secret(world: World) -> None:
    world.cloud("a")
    robot = world.robot()
    world.all_up(robot, ("a",))
    world.run(SETTLED_S)
    world.say(robot, Heartbeat())
    a, shown = world.core.status(world.now)
    assert (a.peer.name, shown.peer.name) == ("a", "robot")
    assert shown.connected
    assert shown.lease_left_s == pytest.approx(world.settings.lease_s)
    assert shown.mapping.state is SyncState.SYNCED
    assert shown.mapping.version_acked > Version(0)
    assert shown.services == robot.services
    assert {(report.interface, report.server) for report in shown.paths} == {("wlan0", "a"), ("wwan0", "a")}
    assert a.mapping.state is SyncState.NOT_SENT
