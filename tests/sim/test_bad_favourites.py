"""Shared requests leave a server that is reached well, but is slow or does not report what it has."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import pytest

from lab.simulated.mesh import Mesh, Node, rule
from plr.protos.model.redundancy_mode import RedundancyMode
from plr.sidecar.core.base.request_id import OBSERVED_ONE_IN
from plr.sidecar.core.robot.dispatch.favourites import MISSES
from plr.sidecar.core.seam.links import SendFinished
from tests.sim.test_mesh import assert_at_most_once, mapped

if TYPE_CHECKING:
    from plr.sidecar.core.link.link import Link

SIZE = 30_000
CALLS = 40
RATE_HZ = 2.0


def two_servers(**changes: object) -> tuple[Mesh, Node, Node, Node]:
    """Return a mesh, a robot that shares requests between two interfaces, its nearest server, and one farther away."""
    mesh = Mesh(3)
    values: dict[str, object] = {"deadline_s": 0.5, "lifetime_s": 5.0, "redundancy": RedundancyMode.SHARE}
    robot = mesh.robot("wlan0", "wwan0", rules=(rule(**{**values, **changes}),))
    near, far = mesh.cloud("cloud-a"), mesh.cloud("cloud-b")
    for interface in ("wlan0", "wwan0"):
        for wire in mesh.both_ways(f"robot.{interface}", "cloud-a.eth0"):
            wire.delay_s = 0.005
        for wire in mesh.both_ways(f"robot.{interface}", "cloud-b.eth0"):
            wire.delay_s = 0.02
    mesh.push_views()
    mesh.run(1.0)
    mapped(mesh, robot, ("wlan0", "cloud-a"), ("wwan0", "cloud-b"))
    return mesh, robot, near, far


def call(mesh: Mesh, robot: Node, calls: int = CALLS) -> Counter[str]:
    """Return how many of the calls ended in which way."""
    for number in range(calls):
        robot.submit(number.to_bytes(4, "big") + bytes(SIZE))
        mesh.run(1.0 / RATE_HZ)
    mesh.run(6.0)
    return Counter({outcome: count for (_, outcome), count in robot.engine.stats.requests.items()})


def slow_down(mesh: Mesh, server: str, bytes_per_s: float) -> None:
    for interface in ("wlan0", "wwan0"):
        mesh.wire(f"robot.{interface}", f"{server}.eth0").bytes_per_s = bytes_per_s


@pytest.mark.parametrize("idempotent", [True, False])
def test_a_server_behind_a_slow_network_is_left(idempotent: bool) -> None:
    mesh, robot, near, far = two_servers(idempotent=idempotent)
    slow_down(mesh, "cloud-a", 5_000)
    outcomes = call(mesh, robot)
    races = 0 if idempotent else CALLS // OBSERVED_ONE_IN  # those of the latter go to the first server mapped
    assert outcomes["ok"] >= CALLS - MISSES - races - 2
    assert_at_most_once(near, far)


def test_it_is_left_when_it_becomes_slow_later() -> None:
    mesh, robot, _, far = two_servers()
    assert call(mesh, robot)["ok"] == CALLS
    slow_down(mesh, "cloud-a", 5_000)
    assert call(mesh, robot)["ok"] >= 2 * CALLS - MISSES - 2
    assert len(far.executed) >= CALLS - MISSES - 2


def deaf(link: Link) -> None:
    """Make a link acknowledge, but never report a message FINISHED."""
    execute = link.execute
    link.execute = lambda command, now: None if isinstance(command, SendFinished) else execute(command, now)  # type: ignore[method-assign]


@pytest.mark.parametrize("mode", [RedundancyMode.SHARE, RedundancyMode.ADAPTIVE, RedundancyMode.HEDGE])
def test_a_server_that_acknowledges_all_and_answers_nothing_is_left(mode: RedundancyMode) -> None:
    mesh, robot, near, _ = two_servers(redundancy=mode)
    near.server_delay = lambda: None
    for link in near.links.values():
        deaf(link)
    outcomes = call(mesh, robot)
    assert outcomes["ok"] >= CALLS - 3
    assert not outcomes["failed"]


def test_where_no_server_is_better_few_bytes_are_spent_on_finding_out() -> None:
    mesh, robot, near, far = two_servers()
    slow_down(mesh, "cloud-a", 5_000)
    slow_down(mesh, "cloud-b", 5_000)
    calls = 4 * CALLS
    outcomes = call(mesh, robot, calls)
    assert not outcomes["ok"]
    sent = sum(robot.engine.stats.copy_bytes.values())
    assert sent <= 1.3 * calls * SIZE, "an eighth are full races"
    assert_at_most_once(near, far)


def test_a_good_server_is_not_left_for_an_outage_of_the_robot() -> None:
    mesh, robot, near, far = two_servers()
    wires = mesh.all_wires_of("robot.wlan0") + mesh.all_wires_of("robot.wwan0")

    def cut(*, to: bool) -> None:
        for wire in wires:
            wire.cut = to

    for at in range(3, 12, 3):
        mesh.at(at, lambda: cut(to=True))
        mesh.at(at + 1.0, lambda: cut(to=False))
    call(mesh, robot)
    assert len(near.executed) > CALLS - 8
    assert len(far.executed) <= CALLS // 3, "full races, and what an outage left without an answer"
