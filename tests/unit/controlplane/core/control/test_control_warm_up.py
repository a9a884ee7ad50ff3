"""A control plane after its restart, and robots that hold peers from before."""

from __future__ import annotations

import pytest

from plr.controlplane.core.control.events import Settings
from plr.protos.convert import parse_in_parts, sidecar_message_to_proto
from plr.protos.convert.reports import PART_ENTRIES
from plr.protos.model.ids import NodeName, Role
from plr.protos.model.members import CandidateSet, ServiceSet
from plr.protos.model.report import Report
from tests.support.control_world import SimSidecar, World
from tests.support.samples import interfaces, path, registration, use

ROBOT = NodeName("robot")


WARM_UP_S = 12.0


def restarted(epoch: int = 5000) -> World:
    return World(Settings(warm_up_s=WARM_UP_S), epoch=epoch)


def come_back(world: World, held: int = 4711) -> SimSidecar:
    robot = world.join(registration("robot", Role.ROBOT, held=held))
    world.say(robot, CandidateSet(interfaces("wlan0", "wwan0")))
    world.say(robot, ServiceSet((), (use(),)))
    return robot


def test_after_a_restart_a_robot_keeps_its_peers_until_those_are_back() -> None:
    world = restarted()
    robot = come_back(world)
    world.all_up(robot, ("a", "b"))
    world.run(1.0)
    world.cloud("a")
    world.run(3.0)
    assert robot.peer_sets == []
    assert robot.mapping_sets == []
    world.cloud("b")
    world.all_up(robot, ("a", "b"))
    world.run(0.2)
    assert robot.peer_names == {"a", "b"}
    assert sorted(robot.pairs().values()) == ["a", "b"]


@pytest.mark.audit("ops-16")
def test_a_robot_whose_report_comes_in_parts_waits_for_all_servers_of_it() -> None:
    world = restarted()
    robot = come_back(world)
    servers = [f"s{number:02d}" for number in range(PART_ENTRIES)]
    for name in servers[1:]:
        world.cloud(name)
    nics = ("wlan0", "wwan0")
    # The first server is in the first part of the paths alone.
    paths = tuple(path(nic, name) for name in servers for nic in nics)
    parts = list(parse_in_parts(sidecar_message_to_proto(Report(paths=paths)).SerializeToString()))
    assert len(parts) > 2
    for _ in range(2):
        for part in parts:
            world.say(robot, part)
            world.run(0.5)
            assert robot.peer_sets == []
    world.cloud(servers[0])
    for part in parts:
        world.say(robot, part)
    world.run(0.5)
    assert robot.peer_names == set(servers)


@pytest.mark.audit("ops-20")
def test_changes_alone_do_not_tell_which_servers_a_robot_waits_for() -> None:
    world = restarted()
    robot = come_back(world)
    world.all_up(robot, ("a", "b"))
    world.run(1.0)
    world.cloud("a")
    world.say(robot, Report(paths=(path("wlan0", "a"),), changes_only=True))
    world.run(1.0)
    assert robot.peer_sets == []
    world.cloud("b")
    world.run(1.0)
    assert robot.peer_names == {"a", "b"}


def test_after_the_warm_up_a_robot_is_told_who_did_not_come_back() -> None:
    world = restarted()
    robot = come_back(world)
    world.cloud("a")
    world.all_up(robot, ("a", "b"))
    world.run(WARM_UP_S - 1.0)
    assert robot.peer_sets == []
    world.run(1.5)
    assert robot.peer_names == {"a"}


def test_a_robot_that_holds_nothing_is_served_during_the_warm_up() -> None:
    world = restarted()
    world.cloud("a")
    robot = world.robot()
    world.run(0.2)
    assert robot.peer_names == {"a"}


def test_versions_grow_over_a_restart_even_if_the_clock_went_back() -> None:
    world = restarted(epoch=10)
    robot = come_back(world, held=4711)
    world.cloud("a")
    world.all_up(robot, ("a",))
    world.run(1.0)
    assert robot.peer_sets[0].version > 4711
    assert robot.mapping_sets[0].version > 4711
