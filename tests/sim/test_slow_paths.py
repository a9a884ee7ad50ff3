"""Round trips of 0.01 to 10 s, also when they change by as much within seconds: nothing is lost, no storm begins."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.simulated.mesh import Mesh, Node, Wire, rule
from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.path.probing import MAX_PROBE_S
from tests.sim.test_mesh import assert_at_most_once, assert_each_answered_once

if TYPE_CHECKING:
    from plr.sidecar.core.path.path import Path

pytestmark = pytest.mark.audit("dp-2")

LIFETIME_S = 120.0
HALF_S = 0.025
"""Of the round trip when nothing is wrong."""
INTRODUCTION_BYTES = 700


def one_path(seed: int, size: int = 1000) -> tuple[Mesh, Node, Wire, Wire]:
    mesh = Mesh(seed)
    robot = mesh.robot("wlan0", rules=(rule(deadline_s=5.0, lifetime_s=LIFETIME_S),))
    mesh.cloud("cloud-a")
    up, down = mesh.both_ways("robot.wlan0", "cloud-a.eth0")
    up.delay_s = down.delay_s = HALF_S
    mesh.push_views()
    mesh.run(2.0)
    return mesh, robot, up, down


def the_path(node: Node) -> Path:
    (link,) = node.links.values()
    (path,) = link._paths.values()
    return path


def ask(mesh: Mesh, robot: Node, seconds: float, rate_hz: float, size: int = 1000) -> int:
    calls = round(seconds * rate_hz)
    for _ in range(calls):
        mesh.calls += 1
        robot.submit(mesh.calls.to_bytes(4, "big") + bytes(size - 4))
        mesh.run(1 / rate_hz)
    return calls


@pytest.mark.parametrize("queue_s", [0.5, 1.0, 2.0, 3.0, 5.0, 9.5])
@pytest.mark.parametrize("ramp_s", [0.01, 2.0, 20.0])
@pytest.mark.parametrize("both", [False, True])
def test_a_queue_of_others_that_grows_to_seconds_delays_requests_and_loses_none(
    queue_s: float, ramp_s: float, both: bool
) -> None:
    mesh, robot, up, down = one_path(1)
    before = up.carried
    calls = ask(mesh, robot, 10.0, 2.0)
    usual = (up.carried - before) / calls
    began, before = mesh.now, up.carried
    slow = 0
    while mesh.now < began + 60.0:
        queue = min(queue_s, queue_s * (mesh.now - began) / ramp_s)
        up.delay_s = HALF_S + queue / (2 if both else 1)
        down.delay_s = HALF_S + queue / 2 if both else HALF_S
        slow += ask(mesh, robot, 0.5, 2.0)
    mesh.run(25.0)
    assert_each_answered_once(robot, calls + slow)
    # What was on its way when the round trip grew may travel a second time, and while it seems dead it is looked for.
    assert (up.carried - before) / slow < 1.5 * usual + 100 * INTRODUCTION_BYTES / slow
    late = [answer.elapsed_s for answer in robot.responses() if answer.elapsed_s > 2.2 * (queue_s + 2 * HALF_S) + 0.1]
    assert not late, "a round trip to find that it is slow, and one more"


@pytest.mark.parametrize("outage_s", [0.5, 3.0, 100.0])
@pytest.mark.parametrize("rtt_s", [0.01, 1.0, 1.7, 2.0, 3.0, 5.0, 10.0])
def test_a_path_is_back_a_round_trip_after_an_outage_however_long_that_takes(outage_s: float, rtt_s: float) -> None:
    mesh, robot, up, down = one_path(1)
    up.cut = down.cut = True
    mesh.run(outage_s)
    up.cut = down.cut = False
    up.delay_s, down.delay_s = rtt_s * 0.9, rtt_s * 0.1
    mesh.run(rtt_s + 1.1 * MAX_PROBE_S)
    assert the_path(robot).state is PathState.UP
    calls = ask(mesh, robot, 20.0, 1.0)
    mesh.run(2 * rtt_s + 1.0)
    assert_each_answered_once(robot, calls)
    (link,) = robot.links.values()
    assert link.stats.dropped["unasked_probe_reply"] == 0


@pytest.mark.parametrize("rtt_s", [3.0, 6.0, 10.0])
def test_first_contact_over_a_slow_path(rtt_s: float) -> None:
    mesh = Mesh(1)
    robot = mesh.robot("wlan0", rules=(rule(deadline_s=5.0, lifetime_s=LIFETIME_S),))
    mesh.cloud("cloud-a")
    up, down = mesh.both_ways("robot.wlan0", "cloud-a.eth0")
    up.delay_s = down.delay_s = rtt_s / 2
    mesh.push_views()
    mesh.run(rtt_s + 0.1)
    assert the_path(robot).state is PathState.UP
    calls = ask(mesh, robot, 10.0, 1.0)
    mesh.run(2 * rtt_s)
    assert_each_answered_once(robot, calls)


@pytest.mark.parametrize("rtt_s", [2.0, 4.0, 10.0])
def test_a_lone_request_over_a_slow_path_that_rested_travels_once(rtt_s: float) -> None:
    """Nothing is under way that could show that the path lives until a whole round trip is over."""
    mesh, robot, up, down = one_path(1)
    up.delay_s = down.delay_s = rtt_s / 2
    calls = ask(mesh, robot, 30.0, 2.0)
    mesh.run(180.0)
    (link,) = robot.links.values()
    for _ in range(3):
        before = link.stats.datagrams["sent", "data"]
        calls += ask(mesh, robot, 3 * rtt_s, 1 / (3 * rtt_s))
        assert link.stats.datagrams["sent", "data"] - before == 1
        assert the_path(robot).state is PathState.UP
        mesh.run(40.0)
    assert_each_answered_once(robot, calls)


@pytest.mark.parametrize("seed", range(8))
def test_whatever_round_trips_and_outages_come_nothing_is_lost_and_bytes_are_bounded(seed: int) -> None:
    mesh = Mesh(seed)
    rng = mesh.rng
    names = ["wlan0", "wwan0"][: rng.choice([1, 1, 2])]
    robot = mesh.robot(*names, rules=(rule(deadline_s=5.0, lifetime_s=LIFETIME_S),))
    cloud = mesh.cloud("cloud-a")
    wires = {name: mesh.both_ways(f"robot.{name}", "cloud-a.eth0") for name in names}
    mesh.push_views()
    mesh.run(2.0)
    size = rng.choice([100, 1000, 20_000])
    calls = 0
    began = mesh.now
    while mesh.now < began + 90.0:
        for pair in wires.values():
            cut = rng.random() < 0.2
            for wire in pair:
                if rng.random() < 0.6:
                    wire.delay_s = 0.5 * 10 ** rng.uniform(-2, 1)
                wire.cut = cut or rng.random() < 0.05
        calls += ask(mesh, robot, rng.choice([0.3, 1.0, 3.0, 10.0]), rng.choice([1.0, 3.0]), size)
    lasted = mesh.now - began
    for pair in wires.values():
        for wire in pair:
            wire.cut, wire.delay_s = False, HALF_S
    mesh.run(15.0)
    assert_each_answered_once(robot, calls)
    assert_at_most_once(cloud)
    assert all(path.state is PathState.UP for link in robot.links.values() for path in link._paths.values())
    # Each copy of a request twice over each path, headers included, and five introductions a second for each path.
    carried = sum(up.carried for up, _ in wires.values())
    assert carried < len(names) * (2 * calls * (size + 300) + 5 * INTRODUCTION_BYTES * lasted)
