"""A cloud whose answers cannot be delivered, faster than the honest one: no request is lost by it."""

from __future__ import annotations

import pytest

from lab.simulated.mesh import Mesh, Node, rule
from plr.sidecar.core.seam.application import DeadlineMissed, RequestFailed

GARBAGE = b"garbage"
REQUESTS = 200
EVERY_S = 0.1
DEADLINE_S = 0.5


def called(bad_share: float, *, seed: int, loss: float = 0.0) -> Node:
    """A robot on two interfaces that called for half a minute: cloud-a answers sooner, and so often wrongly."""
    mesh = Mesh(seed)
    robot = mesh.robot("wlan0", "wwan0", rules=(rule(deadline_s=DEADLINE_S, lifetime_s=5.0),))
    bad, good = mesh.cloud("cloud-a"), mesh.cloud("cloud-b")
    robot.judge = lambda answer: "no such message" if answer == GARBAGE else None
    bad.answer = lambda payload: GARBAGE if mesh.rng.random() < bad_share else b"echo:" + payload
    bad.server_delay, good.server_delay = lambda: 0.0001, lambda: 0.02
    mesh.push_views()
    for interface in ("wlan0", "wwan0"):
        for cloud in ("cloud-a", "cloud-b"):
            for wire in mesh.both_ways(f"robot.{interface}", f"{cloud}.eth0"):
                wire.delay_s, wire.loss = 0.02, loss
    mesh.run(1.0)
    for _ in range(REQUESTS):
        robot.submit(mesh.rng.randbytes(16))
        mesh.run(EVERY_S)
    mesh.run(6.0)
    return robot


@pytest.mark.audit("sec-2")
@pytest.mark.parametrize("loss", [0.0, 0.1])
@pytest.mark.parametrize("bad_share", [1.0, 0.5, 0.1])
def test_no_request_is_lost_or_late_by_a_cloud_that_answers_wrongly(bad_share: float, loss: float) -> None:
    robot = called(bad_share, seed=1, loss=loss)
    stats = robot.engine.stats
    good = {bytes(event.payload) for event in robot.responses()} - {GARBAGE}
    assert len(good) == REQUESTS
    assert not any(isinstance(event, (RequestFailed, DeadlineMissed)) for event in robot.events)
    assert sum(stats.bad_answers.values()) == sum(event.payload == GARBAGE for event in robot.responses())
    if bad_share == 1.0:
        # Out of favour for 10, 20, 40 s: asked again only a few times.
        assert sum(stats.bad_answers.values()) <= 6
