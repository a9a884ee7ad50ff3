"""A service on the robot answers in place of the network, over real ROS."""

from __future__ import annotations

import logging
import signal
from typing import TYPE_CHECKING

import pytest

from plr.protos.model.ids import ServiceName
from plr.sidecar.core.rules.service_rule import FallbackRule, ServiceRule
from tests.ros.mesh import wait_until

if TYPE_CHECKING:
    from tests.ros.mesh import Mesh

pytestmark = pytest.mark.ros

PLAN = ServiceName("/plan")
LOCAL = ServiceName("/plan_locally")
DEADLINE_S = 2.0


def start(mesh: Mesh, *, takes_s: float) -> None:
    """The robot's fallback is asked so long before the deadline."""
    rule = ServiceRule(PLAN, DEADLINE_S, 15.0, idempotent=True, fallback=FallbackRule(LOCAL, takes_s=takes_s))
    mesh.faults.deadline_s = DEADLINE_S
    mesh.use_rules(rule)
    mesh.start()


def counted(mesh: Mesh) -> dict[str, int]:
    return {outcome: count for (_, outcome), count in mesh.robot.stats.fallbacks.items() if count}


def test_without_any_network_the_fallback_answers_in_time_also_after_a_crash(mesh: Mesh) -> None:
    mesh.faults.drop_requests = True
    start(mesh, takes_s=0.5)
    hanging = mesh.serve("--plan", LOCAL, "--busy-s", "60", domain=mesh.robot_domain)
    mesh.wait_carried(PLAN)
    calls = mesh.call(PLAN, "--count", "3", "--timeout-s", "20")
    wait_until(lambda: counted(mesh).get("started"), "a request at the fallback")
    hanging.stop(signal.SIGKILL)  # of which DDS tells nobody for a while
    mesh.serve("--plan", LOCAL, domain=mesh.robot_domain)
    result = mesh.result(calls)
    assert (result["answered"], result["wrong"], result["twice"]) == (3, 0, 0)
    before = counted(mesh)
    assert before.get("won", 0) + before.get("late", 0) == 3
    result = mesh.result(mesh.call(PLAN, "--count", "5", "--first", "10"))
    assert (result["answered"], result["wrong"]) == (5, 0)
    assert counted(mesh)["won"] - before.get("won", 0) == 5
    assert len(mesh.link.answered_locally) == 8
    assert mesh.robot.stats.unanswered == {}


def test_a_network_that_answers_leaves_nothing_to_do_and_both_make_one_answer(
    mesh: Mesh, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("plr.sidecar.ros.robot.fallback_caller.COMPLAIN_AFTER_S", 0.0)
    caplog.set_level(logging.ERROR, "plr.sidecar.ros.robot.fallback_caller")
    start(mesh, takes_s=0.5)
    mesh.serve("--plan", PLAN, "--node", "in_the_cloud")
    mesh.wait_carried(PLAN)
    odd = mesh.serve("--negate", LOCAL, domain=mesh.robot_domain)
    wait_until(lambda: "has type std_srvs/srv/SetBool, not nav_msgs/srv/GetPlan" in caplog.text, "the complaint")
    assert mesh.result(mesh.call(PLAN))["answered"] == 1
    odd.stop(signal.SIGTERM)
    mesh.serve("--plan", LOCAL, domain=mesh.robot_domain)
    wait_until(lambda: mesh.robot.stats.fallback_up[PLAN], "the fallback")
    assert mesh.result(mesh.call(PLAN, "--count", "3"))["answered"] == 3
    assert counted(mesh) == {}
    mesh.faults.delay_s = lambda: 0.85
    result = mesh.result(mesh.call(PLAN, "--count", "2", "--first", "10"))
    assert (result["answered"], result["wrong"], result["twice"]) == (2, 0, 0)
    assert counted(mesh)["started"] == 2
    wait_until(lambda: mesh.link.counts["completed"] == 6, "the network's answers")
    assert not mesh.robot.stats.dropped
