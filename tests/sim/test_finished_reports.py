"""Whoever sent a message learns that it arrived, however many arrive at once: else it holds room until it expires."""

from __future__ import annotations

import pytest

from lab.simulated.mesh import Mesh, rule
from plr.sidecar.core.link import sender
from plr.sidecar.core.seam.links import LinkCommand, SendFinished

pytestmark = pytest.mark.audit("dp-8")


@pytest.mark.parametrize(("count", "late_s"), [(400, 0.02), (1000, 0.05)])
def test_more_answers_in_one_turn_than_a_datagram_reports(count: int, late_s: float) -> None:
    mesh = Mesh(1)
    robot = mesh.robot("wlan0", rules=(rule(deadline_s=1.0, lifetime_s=30.0),))
    cloud = mesh.cloud("cloud-a")
    mesh.push_views()
    mesh.run(1.0)
    robot.late_s = lambda: late_s
    for _ in range(2):
        for _ in range(count):
            robot.submit(b"question")
        mesh.run(3.0)
    assert len(robot.responses()) == 2 * count
    assert len(cloud.engine._outbox) == 0
    assert not robot.links[robot.interfaces[0]].stats.dropped


def test_a_report_that_nobody_sends_again_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """As when the interface went that it waited on, or left by."""
    mesh = Mesh(1)
    robot = mesh.robot("wlan0", rules=(rule(deadline_s=1.0, lifetime_s=200.0),))
    cloud = mesh.cloud("cloud-a")
    cloud.answer = lambda _: bytes(20_000)
    mesh.push_views()
    mesh.run(1.0)
    link = robot.links[robot.interfaces[0]]
    execute = link.execute
    swallowed: list[LinkCommand] = []

    def without_reports(command: LinkCommand, now: float) -> None:
        if isinstance(command, SendFinished):
            swallowed.append(command)
        else:
            execute(command, now)

    monkeypatch.setattr(link, "execute", without_reports)
    robot.submit(b"question")
    mesh.run(0.5)
    assert len(robot.responses()) == len(swallowed) == 1
    monkeypatch.undo()
    mesh.run(5.0)
    assert len(cloud.engine._outbox) == 0


def test_reports_that_nobody_watches_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sender, "MAX_RUNS_IN_FLIGHT", 0)
    mesh = Mesh(1)
    robot = mesh.robot("wlan0", rules=(rule(deadline_s=1.0, lifetime_s=200.0),))
    cloud = mesh.cloud("cloud-a")
    mesh.push_views()
    mesh.run(1.0)
    wire = mesh.wire("robot.wlan0", "cloud-a.eth0")
    for _ in range(100):
        robot.submit(b"question")
    mesh.run(0.0205)
    wire.loss = 0.7
    mesh.run(1.0)
    wire.loss = 0.0
    mesh.run(10.0)
    assert len(robot.responses()) == 100
    assert len(cloud.engine._outbox) == 0
