"""Paths that rest cost next to nothing, and are found dead or alive as soon as that matters."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING

import pytest

from lab.simulated.mesh import Mesh, Node, rule
from plr.protos.model.ids import Role
from plr.protos.model.redundancy_mode import RedundancyMode
from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.link.liveness import PathKeeper
from plr.sidecar.core.path.probing import IDLE_PROBE_S, IDLE_SPREAD, MAX_IDLE_PROBE_S, WATCH_FACTOR
from tests.sim.test_mesh import assert_each_answered_once, mapped, two_by_two

if TYPE_CHECKING:
    from plr.sidecar.core.link.link import Link
    from plr.sidecar.core.path.path import Path

pytestmark = pytest.mark.audit("dp-11")

RESTED_S = 200.0
"""After that, paths that rest are asked as rarely as they ever are."""
RTT_S = 0.02
"""Of the mesh's wires."""


def fleet(robots: int) -> tuple[Mesh, Node, Link]:
    mesh = Mesh(1)
    cloud = mesh.cloud("cloud-a")
    for number in range(robots):
        mesh.add(f"robot{number}", Role.ROBOT, ["wlan0", "wwan0"], (rule(),))
    mesh.push_views()
    return mesh, cloud, cloud.links[cloud.interfaces[0]]


def test_a_cloud_hears_little_of_robots_that_ask_for_nothing() -> None:
    mesh, _, link = fleet(20)
    mesh.run(RESTED_S)
    before = sum(link.stats.datagrams.values())
    mesh.run(60.0)
    each = (sum(link.stats.datagrams.values()) - before) / 60.0 / 40
    # A probe, the reply with a probe, the reply to that; and the drift.
    assert each <= 3 / MAX_IDLE_PROBE_S * 1.1
    assert all(path.state is PathState.UP for path in link._paths.values())


def test_robots_that_began_together_do_not_ask_together() -> None:
    mesh, _, link = fleet(20)
    mesh.run(RESTED_S)
    busiest = total = 0
    for _ in range(60):
        before = link.stats.datagrams["received", "control"]
        mesh.run(1.0)
        heard = link.stats.datagrams["received", "control"] - before
        busiest, total = max(busiest, heard), total + heard
    assert busiest < 6 * total / 60


def test_only_what_stirs_is_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four times a second, each path was measured and its figures written, of however many."""
    looks = {}
    for robots in (5, 20):
        mesh, *_ = fleet(robots)
        mesh.run(RESTED_S)
        seen: list[Path] = []
        with monkeypatch.context() as patched:
            patched.setattr(PathKeeper, "report_measured", lambda _, path, seen=seen: seen.append(path))
            mesh.run(30.0)
        looks[robots] = len(seen) / robots / 2 / 30.0
    # Of the cloud and of the robots alike: about one look for each exchange and end, however many there are.
    assert looks[20] == pytest.approx(looks[5], rel=0.5)
    assert looks[20] < 8 / MAX_IDLE_PROBE_S


def test_each_end_knows_the_round_trip_of_a_path_that_rests() -> None:
    mesh, robot, *clouds = two_by_two()
    mesh.run(RESTED_S)
    for wire in mesh.all_wires_of("robot.wlan0"):
        wire.delay_s = 0.2
    mesh.run(12 * MAX_IDLE_PROBE_S)
    (link,) = (link for name, link in robot.links.items() if name == "wlan0")
    paths = [*link._paths.values()]
    of_clouds = [path for cloud in clouds for path in cloud.links[cloud.interfaces[0]]._paths.values()]
    paths += [path for path in of_clouds if path.remote_id == 0]
    assert len(paths) == 4
    for path in paths:
        assert path.recovery.rtt.smoothed == pytest.approx(0.4, rel=0.3)
    report = robot.engine.take_report(mesh.now)
    assert all(path.up and path.rtt.total > 0 for path in report.paths)


@pytest.mark.parametrize("seed", range(4))
def test_a_request_is_in_time_though_one_of_its_paths_died_while_it_rested(seed: int) -> None:
    mesh, robot, *_ = two_by_two(seed)
    mapped(mesh, robot, ("wlan0", "cloud-a"), ("wwan0", "cloud-b"))
    mesh.run(RESTED_S)
    for wire in mesh.all_wires_of("robot.wlan0"):
        wire.cut = True
    mesh.run(random.Random(seed).uniform(0.0, 2.0))
    robot.submit(b"0000" + bytes(1000))
    mesh.run(0.1)
    assert_each_answered_once(robot, 1)
    assert not robot.responses()[0].late
    mesh.run(1.0 - 0.1)
    dead = robot.links[robot.interfaces[0]]._paths.values()
    assert all(path.state is PathState.DOWN for path in dead), "all its paths, those that no copy took as well"


@pytest.mark.parametrize("seed", range(4))
def test_a_lone_copy_over_a_path_that_died_while_it_rested_is_rescued_within_a_few_round_trips(seed: int) -> None:
    mesh, robot, *_ = two_by_two(seed, redundancy=RedundancyMode.SINGLE)
    mapped(mesh, robot, ("wlan0", "cloud-a"), ("wwan0", "cloud-b"))
    robot.submit(b"warm" + bytes(1000))
    mesh.run(RESTED_S)
    for wire in mesh.all_wires_of("robot.wlan0"):
        wire.cut = True
    mesh.run(random.Random(seed).uniform(0.0, 2.0))
    robot.submit(b"0000" + bytes(1000))
    mesh.run(1.0)
    assert len(robot.responses()) == 2
    assert robot.responses()[-1].elapsed_s < 0.06 + 6 * RTT_S


def test_a_path_that_rested_is_asked_with_the_first_request_and_then_twice_a_second() -> None:
    """Its own or its neighbours': which path is needed next, nobody knows."""
    mesh, robot, *_ = two_by_two(redundancy=RedundancyMode.SINGLE)
    mapped(mesh, robot, ("wlan0", "cloud-a"), ("wwan0", "cloud-b"))
    mesh.run(RESTED_S)
    (beside,) = (path for path in robot.links[robot.interfaces[1]]._paths.values() if path.peer == "cloud-b")
    robot.submit(b"0000" + bytes(1000))
    mesh.run(2 * RTT_S)
    assert mesh.now - beside.probing.last_at < 3 * RTT_S
    for _ in range(20):
        robot.submit(b"0000" + bytes(1000))
        mesh.run(0.25)
        assert mesh.now - beside.probing.last_at < 2 * IDLE_PROBE_S


def test_a_cloud_learns_that_a_robot_vanished_while_nothing_was_asked() -> None:
    mesh, robot, one, _ = two_by_two()
    mesh.run(RESTED_S)
    robot.alive = False
    mesh.run(WATCH_FACTOR * (1 + IDLE_SPREAD) * MAX_IDLE_PROBE_S + 5.0)
    assert all(path.state is PathState.DOWN for path in one.links[one.interfaces[0]]._paths.values())


def test_robots_out_of_reach_do_not_keep_a_cloud_busy() -> None:
    mesh, _, link = fleet(10)
    mesh.run(5.0)
    for node in mesh.nodes.values():
        node.alive = node.role is Role.CLOUD
    mesh.run(1000.0)
    before = sum(link.stats.datagrams.values())
    mesh.run(60.0)
    assert (sum(link.stats.datagrams.values()) - before) / 60.0 / 20 < 0.1
