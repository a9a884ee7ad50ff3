"""What the control plane exports of each member: right, bounded, and shared out."""

from __future__ import annotations

import asyncio
import math
import time
from collections import Counter
from dataclasses import replace

import pytest

from plr.controlplane import turns
from plr.controlplane.cli.status_table import render
from plr.controlplane.config.controlplane import ControlPlaneConfig
from plr.controlplane.core.control.events import Settings
from plr.controlplane.core.estimate.fading import FadedHistogram
from plr.controlplane.core.estimate.network import ReportedPath
from plr.controlplane.core.estimate.unanswered import LATELY_S
from plr.controlplane.core.explain.departed import Departure
from plr.controlplane.core.explain.faults import FLAPS, LOOK_EVERY_S
from plr.controlplane.core.explain.fleet_view import MAX_VIEWED, InterfaceView, MemberView, MissView, ServedView
from plr.controlplane.core.policy.policy import CallRule, OfferRule, Policy
from plr.controlplane.core.registry.registry import Refusal
from plr.controlplane.loop import ControlLoop
from plr.controlplane.observe.event_log import EventLog
from plr.controlplane.observe.fleet_metrics import (
    MAX_GONE_WITH_SERIES,
    MAX_SERIES,
    MAX_SERIES_OF_SERVICES,
    REUSED_S,
    Fleet,
    FleetCollector,
    families,
)
from plr.controlplane.observe.metrics import Metrics
from plr.protos.base.histogram import Histogram
from plr.protos.model.fleet_events import DepartedSidecar, Why
from plr.protos.model.ids import InterfaceName, NodeName, Role, ServiceName
from plr.protos.model.mapping import Assignment, ServiceMapping
from plr.protos.model.members import CandidateSet, InterfaceLabel, RemovalReason, ServiceSet
from plr.protos.model.redundancy_mode import RedundancyMode
from plr.protos.model.report import OutcomeReport, PathReport, Report
from plr.protos.model.stream import Drain
from tests.support.control_world import SETTLED_S, SimSidecar, World
from tests.support.samples import PLAN, histogram, interfaces, latency, offer, path, registration, use
from tests.support.scrapes import fleet_of, series, value

pytestmark = pytest.mark.audit("ops-13")


def test_what_is_known_of_a_robot_is_exported() -> None:
    world = World(Settings(warm_up_s=0.0))
    world.cloud("a")
    robot = world.robot(target_miss=0.01)
    world.say(
        robot,
        Report(
            paths=(
                path("wlan0", "a", rtt=histogram(0.02, 0.03, 0.04, times=9)),
                path("wwan0", "a", up=False),
                path("made-up", "a"),
            ),
            outcomes=(OutcomeReport(PLAN, ok=90, deadline_missed=10),),
        ),
    )
    world.run(SETTLED_S)
    found = series(families(fleet_of(world)))
    wlan, wwan = ({"robot": "robot", "interface": nic, "server": "a"} for nic in ("wlan0", "wwan0"))
    assert value(found, "plr_robot_path_up", **wlan) == 1.0
    assert value(found, "plr_robot_path_up", **wwan) == 0.0
    assert value(found, "plr_robot_path_rtt_seconds", **wlan) == pytest.approx(0.03, rel=0.03)
    assert value(found, "plr_robot_path_rtt_seconds", **wwan) is None
    assert not [key for key in found if ("interface", "made-up") in key[1]]
    assert value(found, "plr_robot_mapping_info", service=PLAN, **wlan) == 1.0
    of_service = {"robot": "robot", "service": PLAN}
    assert value(found, "plr_observed_miss_ratio", **of_service) == pytest.approx(0.1)
    assert value(found, "plr_predicted_miss_probability", **of_service) is not None
    assert value(found, "plr_target_miss_probability", **of_service) == 0.01
    member = {"sidecar": "robot", "role": "robot"}
    assert value(found, "plr_sidecar_up", **member) == 1.0
    assert value(found, "plr_sidecar_certificate_expiry_timestamp_seconds", **member) == 1.8e9
    seen = value(found, "plr_sidecar_last_seen_timestamp_seconds", **member)
    assert seen == pytest.approx(1.7e9, abs=world.settings.lease_s)


def test_whose_network_an_interface_uses_is_told_by_the_robot_or_by_the_interfaces_name() -> None:
    world = World(Settings(warm_up_s=0.0))
    robot = world.robot()
    labels = (InterfaceLabel(InterfaceName("wwan0"), "telekom"), InterfaceLabel(InterfaceName("not0"), "announced"))
    world.say(robot, CandidateSet(interfaces("wlan0", "wwan0"), labels))
    found = series(families(fleet_of(world)))
    told = [dict(key[1]) for key in found if key[0] == "plr_robot_interface_info"]
    assert told == [
        {"robot": "robot", "interface": "wlan0", "carrier": "wlan0"},
        {"robot": "robot", "interface": "wwan0", "carrier": "telekom"},
    ]


def test_an_interface_that_carries_nothing_is_reported_and_its_paths_are_not() -> None:
    world = World(Settings(warm_up_s=0.0))
    world.cloud("a")
    robot = world.robot()
    world.say(robot, Report(paths=(path("wlan0", "a"), path("wwan0", "a"))))
    world.run(SETTLED_S)
    down = (InterfaceLabel(InterfaceName("wwan0"), "telekom"), InterfaceLabel(InterfaceName("eth0")))
    world.say(robot, CandidateSet(interfaces("wlan0"), down=down))
    found = series(families(fleet_of(world)))
    told = {dict(key[1])["interface"]: up for key, up in found.items() if key[0] == "plr_robot_interface_up"}
    assert told == {"wlan0": 1.0, "wwan0": 0.0, "eth0": 0.0}
    assert value(found, "plr_robot_interface_info", robot="robot", interface="wwan0", carrier="telekom") == 1.0
    assert value(found, "plr_robot_interface_info", robot="robot", interface="eth0", carrier="eth0") == 1.0
    paths = {dict(key[1])["interface"] for key in found if key[0] == "plr_robot_path_up"}
    assert paths == {"wlan0"}
    (status,) = world.core.status(world.now, [NodeName("robot")], abridged=True)
    assert (status.down, status.abridged) == (("wwan0", "eth0"), False)
    assert [one.interface for one in status.paths] == ["wlan0"]
    assert "wwan0 DOWN" in render([status])


def test_a_flapping_interface_and_a_restless_server_are_exported() -> None:
    world = World(Settings(warm_up_s=0.0))
    world.cloud("a")
    world.cloud("b")
    robot = world.robot()
    for number in range(1 + FLAPS):
        up = number % 2 == 0
        world.say(robot, Report(paths=(path("wlan0", "a"), path("wwan0", "a", up=up))))
        world.run(LOOK_EVERY_S)
    found = series(families(fleet_of(world)))
    wlan, wwan = ({"robot": "robot", "interface": nic} for nic in ("wlan0", "wwan0"))
    assert value(found, "plr_robot_interface_changes_total", **wlan) == 0.0
    assert value(found, "plr_robot_interface_changes_total", **wwan) == FLAPS
    assert value(found, "plr_robot_interface_fault", fault="flapping", **wlan) == 0.0
    assert value(found, "plr_robot_interface_fault", fault="flapping", **wwan) == 1.0
    assert value(found, "plr_robot_interface_fault", fault="useless", **wwan) == 0.0
    for number in range(2 + FLAPS):
        both = [path(nic, "b", up=number % 2 == 0) for nic in ("wlan0", "wwan0")]
        world.say(robot, Report(paths=(*both, path("wlan0", "a"), path("wwan0", "a"))))
        world.run(LOOK_EVERY_S)
    found = series(families(fleet_of(world)))
    assert value(found, "plr_server_robots", server="a", path="restless") == 0.0
    assert value(found, "plr_server_robots", server="b", path="restless") == 1.0


def test_nobody_is_told_which_interfaces_carry_nothing() -> None:
    world = World(Settings(warm_up_s=0.0))
    cloud = world.cloud("a")
    robot = world.robot()
    world.run(SETTLED_S)
    sets, solvings = len(cloud.peer_sets), world.solvings
    world.say(robot, CandidateSet(interfaces("wlan0", "wwan0"), down=(InterfaceLabel(InterfaceName("eth0")),)))
    world.run(SETTLED_S)
    assert (len(cloud.peer_sets), world.solvings) == (sets, solvings)


def test_requests_are_counted_and_the_counts_begin_at_nothing() -> None:
    world = World(Settings(warm_up_s=0.0))
    world.cloud("a")
    robot = world.robot()
    world.run(SETTLED_S)
    of_service = {"robot": "robot", "service": PLAN}

    def counted() -> tuple[float | None, float | None]:
        found = series(families(fleet_of(world)))
        names = ("plr_robot_requests_total", "plr_robot_requests_missed_total")
        return tuple(value(found, name, **of_service) for name in names)  # type: ignore[return-value]  # two of them

    assert counted() == (0.0, 0.0)
    for _ in range(2):
        world.say(robot, Report(outcomes=(OutcomeReport(PLAN, ok=90, deadline_missed=7, failed=3),)))
    assert counted() == (200.0, 20.0)


def test_a_service_that_nobody_serves_goes_over_no_path_whoever_says_so() -> None:
    world = World(Settings(warm_up_s=0.0))
    server = world.cloud("a")
    robot = world.robot()
    world.say(robot, Report(paths=(path("wlan0", "a"), path("wwan0", "a"))))
    world.run(SETTLED_S)

    def paths() -> dict[str, float]:
        found = series(families(fleet_of(world)))
        return {dict(key[1])["service"]: n for key, n in found.items() if key[0] == "plr_robot_service_paths"}

    assert paths() == {PLAN: 2.0}
    world.say(server, ServiceSet())
    world.run(SETTLED_S)
    assert paths() == {PLAN: 0.0}, "its ROS server is gone"
    world.say(robot, ServiceSet(unmet=(PLAN,)))
    assert paths() == {PLAN: 0.0}, "the robot has withdrawn it"
    world.say(robot, ServiceSet())
    assert paths() == {PLAN: 0.0}, "a glob of its configuration may name it: it carried it until nobody offered it"
    world.say(server, ServiceSet((offer(),)))
    assert paths() == {}, "it is served: the robot has another reason"
    world.leave(server)
    assert paths() == {PLAN: 0.0}
    world.leave(robot)
    world.say(world.join(registration("robot")), ServiceSet())
    assert paths() == {}, "another run, which may be configured otherwise"


@pytest.mark.audit("ops-12")
def test_a_service_whose_servers_a_robot_misses_has_no_path_unless_it_misses_all_servers() -> None:
    world = World(Settings(warm_up_s=0.0))
    world.cloud("a")
    world.say(world.cloud("b"), ServiceSet((offer("/other"),)))
    robot = world.robot()
    world.say(robot, ServiceSet(unreached=(PLAN,)))

    def paths(*reported: PathReport) -> dict[str, float]:
        world.say(robot, Report(paths=reported))
        found = series(families(fleet_of(world)))
        return {dict(key[1])["service"]: n for key, n in found.items() if key[0] == "plr_robot_service_paths"}

    down = path("wlan0", "a", up=False)
    assert paths(down, path("wlan0", "b")) == {PLAN: 0.0}
    assert paths(down, path("wlan0", "b", up=False)) == {}, "PlrRobotNoPath, or PlrServerDown, tells it"


def test_a_policy_that_forbids_a_service_leaves_it_no_path() -> None:
    world = World(Settings(warm_up_s=0.0))
    world.cloud("a")
    robot = world.robot()
    world.say(robot, Report(paths=(path("wlan0", "a"),)))
    world.run(SETTLED_S)
    world.core.set_policy(Policy(), world.now)
    world.run(SETTLED_S)
    found = series(families(fleet_of(world)))
    assert value(found, "plr_robot_service_paths", robot="robot", service=PLAN) == 0.0


def served(world: World, server: str) -> dict[str, tuple[float, float | None]]:
    """Whether it serves each service, and how many requests in a row it left unanswered."""
    found = series(families(fleet_of(world)))
    ups = {key[1]: up for key, up in found.items() if key[0] == "plr_server_service_up"}
    return {
        dict(labels)["service"]: (up, found["plr_server_service_unanswered", labels])
        for labels, up in ups.items()
        if ("server", server) in labels
    }


@pytest.mark.audit("ops-12")
def test_a_server_that_lost_a_service_is_reported_and_one_that_goes_in_order_is_not() -> None:
    world = World(Settings(warm_up_s=0.0))
    server = world.cloud("a")
    assert served(world, "a") == {PLAN: (1.0, 0.0)}
    world.say(server, ServiceSet(unmet=(ServiceName("/named"),)))
    assert served(world, "a") == {PLAN: (0.0, 0.0), "/named": (0.0, 0.0)}, "by a glob, and by its name"
    (status,) = world.core.status(world.now)
    assert (status.withdrawn, status.unmet) == ((PLAN,), ("/named",))
    assert f"LOST {PLAN}" in render([status])
    world.say(server, ServiceSet((offer(), offer("/named")), unmet=(PLAN,)))
    samples = [
        sample.labels for one in families(fleet_of(world)) for sample in one.samples if "_service_up" in sample.name
    ]
    assert len(samples) == 2, "one series each, whatever it says"
    world.say(server, ServiceSet((offer(), offer("/named"))))
    assert served(world, "a") == {PLAN: (1.0, 0.0), "/named": (1.0, 0.0)}
    world.say(server, ServiceSet((offer("/named"),)))
    world.say(server, Drain())
    assert served(world, "a") == {}, "it is about to be stopped"
    world.leave(server)
    world.say(world.join(registration("a", Role.CLOUD)), ServiceSet((offer("/named"),)))
    assert served(world, "a") == {"/named": (1.0, 0.0)}, "a new run, which may be configured otherwise"


@pytest.mark.audit("ops-12")
def test_what_the_policy_lets_nobody_offer_is_not_missed() -> None:
    world = World(Settings(warm_up_s=0.0))
    server = world.cloud("a")
    world.say(server, ServiceSet(unmet=(ServiceName("/named"),)))
    world.core.set_policy(Policy(), world.now)
    assert served(world, "a") == {}


@pytest.mark.audit("ops-12")
def test_a_server_that_answers_nobody_is_reported_until_it_answers_somebody() -> None:
    world = World(Settings(warm_up_s=0.0))
    server = world.cloud("a")
    world.cloud("b")
    robot, other = world.robot(), world.robot("other")

    def reports(who: SimSidecar, *, answered: int = 0, lost: int = 0, name: str = "a") -> float | None:
        times = histogram(0.01, times=answered, lost=lost)
        world.say(who, Report(latencies=(latency("wlan0", name, histogram(0.02), processing=times),)))
        return served(world, "a")[PLAN][1]

    assert reports(robot, answered=3) == 0.0
    assert reports(robot, lost=3) == 3.0
    assert reports(robot) == 3.0, "what the network lost tells nothing of it"
    assert reports(robot, answered=9, name="b") == 3.0, "nor what another server answers"
    assert reports(other, lost=4) == 6.0, "of two neither counts for more than the other"
    (status,) = world.core.status(world.now, [NodeName("a")])
    assert status.unanswered == {PLAN: 6}
    assert f"UNANSWERED {PLAN}: received the last 6 requests" in render([status])
    of_both = (histogram(0.01), histogram(lost=9))
    latencies = [
        latency(nic, "a", Histogram(), processing=of) for nic, of in zip(("wlan0", "wwan0"), of_both, strict=True)
    ]
    world.say(other, Report(latencies=tuple(latencies)))
    assert served(world, "a")[PLAN] == (1.0, 0.0)
    assert reports(robot, lost=2) == 0.0, "it answered the other one a moment ago"
    world.run(LATELY_S + 1.0)
    assert reports(robot) == 5.0
    world.say(server, ServiceSet())
    world.say(server, ServiceSet((offer(),)))
    assert served(world, "a") == {PLAN: (1.0, 0.0)}, "its node was restarted"
    assert reports(robot, lost=5) == 5.0
    world.drop_stream(server)
    world.say(world.join(registration("a", Role.CLOUD, incarnation=2)), ServiceSet((offer(),)))
    assert served(world, "a") == {PLAN: (1.0, 0.0)}, "the whole host was"
    assert len(world.core.unanswered) == 1, "that of the other server"


@pytest.mark.audit("ops-12")
def test_who_is_gone_has_no_row_of_unanswered_requests_nor_a_word_on_one() -> None:
    world = World(Settings(warm_up_s=0.0))
    servers = world.cloud("a"), world.cloud("b")
    robots = world.robot(), world.robot("other")
    for robot in robots:
        for name in ("a", "b"):
            world.say(robot, Report(latencies=(latency("wlan0", name, histogram(), processing=histogram(lost=5)),)))
    assert served(world, "b")[PLAN] == (1.0, 10.0)
    world.leave(servers[0])
    assert len(world.core.unanswered) == 1
    world.leave(robots[0])
    assert served(world, "b")[PLAN] == (1.0, 5.0)
    world.core.part_with(NodeName("other"), RemovalReason.REVOKED, world.now)
    assert served(world, "b")[PLAN] == (1.0, 0.0)
    assert len(world.core.unanswered) == 0


@pytest.mark.audit("ops-12")
def test_a_robot_learns_of_the_servers_that_the_policy_lets_it_call() -> None:
    """Where the only one is stopped, no network of the robot is at fault."""
    world = World(Settings(warm_up_s=0.0))
    first = world.cloud("a")
    world.cloud("b")
    world.robot("first")
    world.robot("second")

    def servers() -> list[float | None]:
        world.run(SETTLED_S)
        found = series(families(fleet_of(world)))
        return [value(found, "plr_robot_servers", robot=name) for name in ("first", "second")]

    assert servers() == [2.0, 2.0]
    calls = (CallRule(("first",), ("*",), ("a",)), CallRule(("second",), ("*",), ("*",)))
    world.core.set_policy(Policy(calls, (OfferRule(("*",), ("*",)),)), world.now)
    assert servers() == [1.0, 2.0]
    world.leave(first)
    assert servers() == [0.0, 1.0]


def test_who_has_never_reached_a_server_is_no_witness_of_its_end() -> None:
    """Of two sites, each with a server that the other's robots do not reach."""
    world = World(Settings(warm_up_s=0.0))
    for name in ("a", "b", "new"):
        world.cloud(name)
    first, second = world.robot("first"), world.robot("second")

    def says(robot: SimSidecar, *up: str) -> None:
        world.say(robot, Report(paths=tuple(path("wlan0", name, up=name in up) for name in ("a", "b", "new"))))

    def robots(server: str) -> tuple[float | None, ...]:
        found = series(families(fleet_of(world)))
        return tuple(value(found, "plr_server_robots", server=server, path=path) for path in ("up", "lost", "never"))

    says(first, "a")
    says(second, "b")
    assert [robots(name) for name in ("a", "b", "new")] == [(1, 0, 0), (1, 0, 0), (0, 0, 2)]
    world.leave(second)
    assert [robots(name) for name in ("a", "b", "new")] == [(1, 0, 0), (0, 0, 0), (0, 0, 1)]
    second = world.robot("second")
    says(second, "a")
    assert robots("b") == (0, 1, 0), "it did before it was stopped"
    says(second)
    assert robots("b") == (0, 0, 0), "who reaches nobody blames nobody"


@pytest.mark.audit("ops-11")
def test_paths_to_who_said_goodbye_or_is_forbidden_are_not_reported_as_up() -> None:
    world = World(Settings(warm_up_s=0.0))
    left, kept = world.cloud("a"), world.cloud("b")
    robot = world.robot()
    world.say(robot, Report(paths=(path("wlan0", "a"), path("wlan0", "b"))))
    world.run(SETTLED_S)

    def told() -> tuple[list[str], list[str]]:
        found = series(families(fleet_of(world)))
        (status,) = world.core.status(world.now, [NodeName("robot")])
        exported = [dict(key[1])["server"] for key in found if key[0] == "plr_robot_path_up"]
        return exported, [one.server for one in status.paths]

    assert told() == (["a", "b"], ["a", "b"])
    world.leave(left)
    assert told() == (["b"], ["b"])
    world.core.set_policy(Policy(), world.now)
    assert told() == ([], [])
    assert kept.stream is not None


def test_a_target_is_reported_also_where_the_mapping_is_not_chosen_by_it() -> None:
    world = World(Settings(warm_up_s=0.0))
    robot = world.robot()
    world.say(robot, ServiceSet((), (replace(use(), redundancy=RedundancyMode.ADAPTIVE, wanted_miss=0.01),)))
    found = series(families(fleet_of(world)))
    assert value(found, "plr_target_miss_probability", robot="robot", service=PLAN) == 0.01


def test_paths_to_a_server_that_is_gone_have_no_series() -> None:
    world = World(Settings(warm_up_s=0.0))
    server = world.cloud("a")
    world.cloud("b")
    robot = world.robot()
    world.say(robot, Report(paths=(path("wlan0", "a"), path("wlan0", "b"))))
    world.say(robot, Report(paths=(path("wlan0", "a", up=False), path("wlan0", "b"))))
    world.run(SETTLED_S)

    def servers() -> set[str]:
        return {dict(key[1])["server"] for key in series(families(fleet_of(world))) if key[0] == "plr_robot_path_up"}

    assert servers() == {"a", "b"}
    world.drop_stream(server)
    world.run(world.settings.lease_s + 1.0)
    assert servers() == {"b"}


def test_who_does_not_confirm_its_mapping_is_reported() -> None:
    world = World(Settings(warm_up_s=0.0))
    world.cloud("a")
    robot = world.robot()
    assert value(series(families(fleet_of(world))), "plr_robot_mapping_synced", robot="robot") == 1.0
    robot.silent = True
    world.run(SETTLED_S)
    assert value(series(families(fleet_of(world))), "plr_robot_mapping_synced", robot="robot") == 0.0


def test_who_is_gone_has_series_that_say_so() -> None:
    world = World(Settings(warm_up_s=0.0))
    robot = world.robot()
    world.run(SETTLED_S)
    member = {"sidecar": "robot", "role": "robot"}
    world.drop_stream(robot)
    found = series(families(fleet_of(world)))
    assert value(found, "plr_sidecar_up", **member) == 0.0
    assert value(found, "plr_sidecar_gone_info", why="lease_expired", **member) is None
    world.run(world.settings.lease_s + 100.0)
    found = series(families(fleet_of(world)))
    assert value(found, "plr_sidecar_up", **member) == 0.0
    assert value(found, "plr_sidecar_gone_info", why="lease_expired", **member) == 1.0
    seen = value(found, "plr_sidecar_last_seen_timestamp_seconds", **member)
    assert seen == pytest.approx(1.7e9 - world.settings.lease_s - 100.0, abs=world.settings.lease_s)
    assert value(found, "plr_sidecar_gone_timestamp_seconds", **member) == pytest.approx(1.7e9 - 100.0, abs=0.5)
    world.robot()
    found = series(families(fleet_of(world)))
    assert value(found, "plr_sidecar_up", **member) == 1.0
    assert value(found, "plr_sidecar_gone_info", why="lease_expired", **member) is None


def test_who_died_together_with_the_control_plane_is_gone_since_it_was_found_out() -> None:
    """However long before that anything was heard of it: the alerts look at who went within a day."""
    world = World(Settings(warm_up_s=0.0))
    lost = Departure(NodeName("a"), Role.CLOUD, Why.LEASE_EXPIRED, world.now - 1e6, world.now - 1e6)
    world.core.remember([], [lost], world.now)
    world.run(world.settings.lease_s + 1.0)
    found = series(families(fleet_of(world)))
    member = {"sidecar": "a", "role": "cloud"}
    assert value(found, "plr_sidecar_gone_info", why="lease_expired", **member) == 1.0
    assert value(found, "plr_sidecar_gone_timestamp_seconds", **member) == pytest.approx(1.7e9, abs=2.0)
    assert value(found, "plr_sidecar_last_seen_timestamp_seconds", **member) == pytest.approx(1.699e9, abs=10.0)


def test_a_member_is_reported_once_also_where_the_policy_cut_it_off() -> None:
    world = World(Settings(warm_up_s=0.0))
    world.robot()
    world.say(world.sidecars[NodeName("robot")], ServiceSet((), (use(),)))
    fleet = fleet_of(world)
    cut = DepartedSidecar(NodeName("robot"), Role.ROBOT, Why.POLICY, 1.0, 1.0)
    found = Fleet(fleet.members, [cut], {}, fleet.now, fleet.now_wall)
    names = Counter((sample.name, *sorted(sample.labels.items())) for m in families(found) for sample in m.samples)
    assert max(names.values()) == 1
    assert value(series(families(found)), "plr_sidecar_up", sidecar="robot", role="robot") == 1.0


def robot_view(name: str, interfaces: int, servers: int, services: int) -> MemberView:
    nics = [InterfaceName(f"nic{number}") for number in range(interfaces)]
    clouds = [NodeName(f"cloud-{number}") for number in range(servers)]
    names = [ServiceName(f"/service_{number}") for number in range(services)]
    return MemberView(
        name=NodeName(name),
        role=Role.ROBOT,
        connected=True,
        seen_at=0.0,
        paths=tuple(ReportedPath(nic, cloud, True, 0.03) for nic in nics for cloud in clouds),
        mapping=tuple(
            ServiceMapping(service, tuple(Assignment(nic, cloud) for nic, cloud in zip(nics, clouds, strict=False)))
            for service in names
        ),
        misses=tuple(MissView(service, 0.001, 0.002, 0.01, 10, 1) for service in names),
        paths_of_services=tuple((service, interfaces) for service in names),
        interfaces=tuple(InterfaceView(nic, "carrier", up=True) for nic in nics),
    )


def cloud_view(name: str, services: int) -> MemberView:
    served = tuple(ServedView(ServiceName(f"/service_{number}"), up=True, unanswered=0) for number in range(services))
    return MemberView(NodeName(name), Role.CLOUD, True, 0.0, served=served)


def fleet(robots: list[MemberView], *, gone: int = 0, clouds: int = 5, services: int = 1) -> Fleet:
    servers = [cloud_view(f"cloud-{number}", services) for number in range(clouds)]
    members = [*robots, *servers]
    left = [DepartedSidecar(NodeName(f"gone-{n}"), Role.ROBOT, Why.LEASE_EXPIRED, 1.0, 1.0) for n in range(gone)]
    return Fleet(members, left, {member.name: 1.0 for member in members}, 0.0, 0.0)


@pytest.mark.parametrize(("services", "expected"), [(1, 59_046), (4, 86_076)])
def test_a_thousand_robots_take_as_many_series_as_documented(services: int, expected: int) -> None:
    robots = [robot_view(f"robot-{number}", 3, 5, services) for number in range(1000)]
    found = series(families(fleet(robots, services=services)))
    assert len(found) == expected
    assert value(found, "plr_fleet_series_left_out") == 0.0


def test_series_are_bounded_and_one_robot_takes_none_of_others() -> None:
    robots = [robot_view(f"robot-{number}", 3, 5, 4) for number in range(999)]
    greedy = robot_view("greedy", 64, 64, 64)
    found = series(families(fleet([greedy, *robots], gone=MAX_GONE_WITH_SERIES)))
    assert len(found) <= MAX_SERIES + 1
    of_robot = Counter(dict(labels).get("robot") for _, labels in found)
    assert {of_robot[f"robot-{number}"] for number in range(999)} == {83}
    assert of_robot["greedy"] < 100
    assert (value(found, "plr_fleet_series_left_out") or 0.0) > 1000.0


def test_servers_have_equal_shares_for_their_services_and_what_is_missed_comes_first() -> None:
    world = World(Settings(warm_up_s=0.0))
    server = world.cloud("a")
    world.say(server, ServiceSet(tuple(offer(f"/glob/{number:04}") for number in range(1000)), unmet=(PLAN,)))
    (view,) = fleet_of(world).members
    assert (view.served[0], len(view.served)) == (ServedView(PLAN, up=False, unanswered=0), MAX_VIEWED)
    found = series(families(fleet([], clouds=100, services=MAX_VIEWED)))
    of_server = Counter(dict(labels)["server"] for name, labels in found if name == "plr_server_service_up")
    assert set(of_server.values()) == {MAX_SERIES_OF_SERVICES // 2 // 100}
    left_out = 100 * (MAX_VIEWED - MAX_SERIES_OF_SERVICES // 2 // 100) * 2
    assert value(found, "plr_fleet_series_left_out") == left_out


def test_also_as_many_members_as_can_be_there_at_all() -> None:
    robots = [robot_view(f"robot-{number}", 8, 8, 8) for number in range(4096)]
    assert len(series(families(fleet(robots, gone=MAX_GONE_WITH_SERIES)))) <= MAX_SERIES + 1
    assert (
        len(series(families(fleet(robots[:3000], gone=MAX_GONE_WITH_SERIES, clouds=1096, services=64))))
        <= MAX_SERIES + 1
    )


@pytest.mark.parametrize("seconds", [0.001, 0.03, 5.0])
def test_the_median_is_that_of_the_histogram(seconds: float) -> None:
    faded = FadedHistogram(30.0, now=0.0)
    assert math.isnan(faded.median_once())
    faded.add(histogram(seconds, seconds * 1.5, seconds / 1.5), now=0.0)
    assert faded.median_once() == pytest.approx(seconds, rel=0.03)
    assert faded.median_once() == faded.median()
    faded.add(Histogram(), now=1e6)
    assert math.isnan(faded.median_once()), "all of it is forgotten"


@pytest.mark.parametrize("threaded", [False, True])
def test_gathering_leaves_the_loop_to_others_in_between(threaded: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    members = 100
    monkeypatch.setattr(turns, "TURN_S", 0.0)

    async def gather() -> tuple[Fleet, int]:
        loop = make_loop()
        for number in range(members):
            assert not isinstance(loop.register(registration(f"robot-{number}"), None), Refusal)
        passes = 0

        async def others() -> None:
            nonlocal passes
            while True:
                passes += 1
                await asyncio.sleep(0)

        other = asyncio.create_task(others())
        fleet = await asyncio.to_thread(loop.ask_fleet) if threaded else await loop.gather_fleet()
        other.cancel()
        return fleet, passes

    found, passes = asyncio.run(gather())
    assert len(found.members) == members
    assert passes >= members


def make_loop() -> ControlLoop:
    return ControlLoop(ControlPlaneConfig(insecure=True, listen="127.0.0.1:0"), Metrics(), EventLog(None))


def test_a_loop_that_has_ended_gives_no_fleet() -> None:
    async def make() -> ControlLoop:
        return make_loop()

    loop = asyncio.run(make())
    with pytest.raises(TimeoutError):
        loop.ask_fleet()


def test_scrapes_at_once_share_their_values_and_a_busy_loop_gives_none() -> None:
    asked = 0

    def ask() -> Fleet:
        nonlocal asked
        asked += 1
        if asked > 1:
            raise TimeoutError
        return fleet([])

    collector = FleetCollector(ask)
    assert collector.collect()
    assert collector.collect()
    assert asked == 1
    time.sleep(REUSED_S)
    assert not list(collector.collect())
