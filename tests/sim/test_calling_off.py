"""When the first answer wins, the rest is not sent, not run, not answered; no backlog delays what is asked now."""

from __future__ import annotations

import pytest

from lab.simulated.mesh import SERVICE, Mesh, Node
from plr.protos.model.ids import InterfaceName, NodeName
from plr.sidecar.core.base import request_id as identity
from plr.sidecar.core.base.request_id import OBSERVED_ONE_IN
from plr.sidecar.core.base.values import PathState
from tests.sim.serial_server import SerialServer
from tests.sim.test_mesh import assert_at_most_once, assert_each_answered_once, call_at, mapped, two_by_two


def split(*, deadline_s: float = 0.1, lifetime_s: float = 10.0) -> tuple[Mesh, Node, Node, Node]:
    """One server over each interface."""
    mesh, robot, one, two = two_by_two(deadline_s=deadline_s, lifetime_s=lifetime_s)
    mapped(mesh, robot, ("wlan0", "cloud-a"), ("wwan0", "cloud-b"))
    return mesh, robot, one, two


def carried_by_a_slow_loser() -> int:
    """1 Mbit/s for calls of 3.2 Mbit, one a second."""
    mesh, robot, *_ = split(deadline_s=5.0)
    wire = mesh.wire("robot.wwan0", "cloud-b.eth0")
    wire.bytes_per_s = 125_000
    before = wire.carried
    calls = call_at(mesh, robot, 1, 20, size=400_000)
    assert_each_answered_once(robot, calls)
    mesh.run(12.0)
    assert robot.engine.busy == 0
    return wire.carried - before


def test_a_slow_path_carries_little_of_what_it_cannot_win(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as always:
        always.setattr(identity, "OBSERVED_ONE_IN", 1)
        races_only = carried_by_a_slow_loser()
    assert carried_by_a_slow_loser() < 0.7 * races_only


def test_a_slow_server_runs_little_and_answers_less() -> None:
    mesh, robot, one, two = split(lifetime_s=30.0)
    slow = SerialServer(mesh, two, busy_s=0.5)
    slow.answer = bytes(50_000)
    wire = mesh.wire("cloud-b.eth0", "robot.wwan0")
    before = wire.carried
    calls = call_at(mesh, robot, 20, 20)
    assert len(one.executed) == calls
    mesh.run(40.0)
    assert_each_answered_once(robot, calls)
    assert slow.ran < 0.3 * calls, "one request in eight is a race; of the others, those that found it idle"
    assert wire.carried - before < 1.3 * 50_000 * calls / OBSERVED_ONE_IN * 1.5
    assert slow.window.waiting == 0
    assert robot.engine.busy == two.engine.busy == 0


def test_a_cancel_that_overtakes_its_request_keeps_it_from_running() -> None:
    mesh, robot, _, two = split()
    for wire in mesh.both_ways("robot.wwan0", "cloud-b.eth0"):
        wire.delay_s = 0.3
    mesh.run(3.0)
    calls = call_at(mesh, robot, 20, 10)
    mesh.run(2.0)
    assert_each_answered_once(robot, calls)
    called_off = robot.engine.stats.called_off[InterfaceName("wwan0"), NodeName("cloud-b"), SERVICE]
    assert called_off > calls / 2
    assert len(two.executed) == calls - called_off
    assert two.engine.stats.executions[SERVICE, "cancelled"] == called_off


@pytest.mark.parametrize("seed", range(20))
def test_lost_doubled_and_late_cancels_change_no_answer(seed: int) -> None:
    mesh, robot, one, two = two_by_two(seed + 500)
    servers = [SerialServer(mesh, node, busy_s=mesh.rng.choice([0.001, 0.02, 0.2])) for node in (one, two)]
    for wire in mesh.wires.values():
        wire.loss = mesh.rng.uniform(0, 0.2)
        wire.duplicate = mesh.rng.uniform(0, 0.3)
        wire.jitter_s = mesh.rng.choice([0.0, 0.005, 0.1])
    calls = call_at(mesh, robot, 4, 8, size=mesh.rng.choice([10, 1500, 30_000]))
    mesh.run(15.0)
    assert_each_answered_once(robot, calls)
    assert_at_most_once(one, two)
    assert robot.engine.busy == one.engine.busy == two.engine.busy == 0
    assert all(server.window.waiting == 0 for server in servers)


def call_after_an_outage(dark_s: float, wait_s: float) -> float:
    """Ask 120 kB at 10 Hz, also while both links are dark; return how long a call takes `wait_s` after a path is up.

    The backlog takes the paths for two seconds and the servers for one.
    """
    mesh, robot, one, two = two_by_two(deadline_s=0.2, lifetime_s=60.0)
    for node in (one, two):
        SerialServer(mesh, node, busy_s=0.02)
    for wire in mesh.wires.values():
        wire.bytes_per_s = 5_000_000
    calls = call_at(mesh, robot, 10, 2, size=120_000)
    wires = mesh.all_wires_of("robot.wlan0") + mesh.all_wires_of("robot.wwan0")
    for wire in wires:
        wire.cut = True
    calls += call_at(mesh, robot, 10, dark_s, size=120_000)
    for wire in wires:
        wire.cut = False
    while not any(route.state is PathState.UP for route in robot.engine.routes.usable(robot.engine.peers.names())):
        mesh.run(0.001)
    mesh.run(wait_s)
    asked = robot.submit(b"\xff\xff\xff\xff" + bytes(120_000))
    waiting = robot.engine.busy
    assert robot.engine._outbox.held_bytes <= 2 * 121_000 * (calls + 1)
    mesh.run(30.0)
    assert_each_answered_once(robot, calls + 1)
    assert_at_most_once(one, two)
    for node in (robot, one, two):
        assert node.engine.busy == 0
        assert node.engine._outbox.held_bytes == 0
    assert waiting > 5 * dark_s, "there was a backlog"
    return next(event.elapsed_s for event in robot.responses() if event.request_id == asked)


def test_after_an_outage_what_is_asked_does_not_wait_for_the_backlog() -> None:
    undisturbed = call_after_an_outage(0.0, 0.0)
    for wait_s in (0.0, 0.1, 0.5):
        after = call_after_an_outage(10.0, wait_s)
        assert after < undisturbed + 0.035, "a late request may be at the server, and symbols in the network's queue"
