"""No job of the backlog keeps another one, or a timer, waiting for ever."""

from __future__ import annotations

from functools import partial

import pytest

from lab.simulated.mesh import Mesh, rule
from plr.sidecar.core.base.slices import SLICE, Backlog
from plr.sidecar.core.seam.application import RequestFailed

pytestmark = pytest.mark.audit("dp-10")


def test_a_job_that_is_asked_for_again_and_again_lets_others_have_their_turn() -> None:
    backlog, done = Backlog(), list[float]()

    def look_after_many() -> list[partial[None]]:
        return [partial(lambda _now: None)] * (10 * SLICE)

    backlog.add(look_after_many, 0.0, "again")
    backlog.add_steps([done.append], 0.0)
    for turn in range(1, 100):
        backlog.add(look_after_many, turn, "again")
        backlog.begin_turn(turn)
        backlog.run(turn)
    assert len(done) == 1


def test_lifetimes_end_while_there_is_work_without_end() -> None:
    mesh = Mesh(1)
    robot = mesh.robot("wlan0", rules=(rule(lifetime_s=0.2),))
    mesh.cloud("a").server_delay = lambda: None
    mesh.push_views()
    mesh.run(2)
    robot.submit(b"")
    robot.engine._backlog.add_steps([lambda _now: None] * (1000 * SLICE), mesh.now)
    for turn in range(1, 500):
        robot.engine.handle_timer(mesh.now + turn / 1000)
    assert [type(event) for event in robot.engine.take_events()].count(RequestFailed) == 1
