"""Stopping: nothing hangs, nothing is printed, no thread stays."""

from __future__ import annotations

import signal
import threading
from typing import TYPE_CHECKING

import pytest

from plr.protos.model.ids import Role
from plr.sidecar.core.base.values import RejectReason
from plr.sidecar.ros.bridge import RosBridge
from tests.ros.mesh import wait_until
from tests.ros.processes import Program

if TYPE_CHECKING:
    from pathlib import Path

    from tests.ros.mesh import Mesh

pytestmark = pytest.mark.ros


def test_stopping_the_cloud_refuses_what_is_running(mesh: Mesh) -> None:
    mesh.start()
    mesh.serve("--plan", "/plan")
    mesh.wait_carried("/plan")
    mesh.call("/plan", "--count", "30", "--tolerance", "-1", "--timeout-s", "1")
    wait_until(lambda: mesh.cloud.stats.pending == 30, "30 requests in the cloud")
    assert mesh.cloud.stop()
    reasons = [reason for reason, _ in mesh.link.refusals]
    assert len(reasons) == 30
    assert set(reasons) == {RejectReason.SERVER_LOST, RejectReason.DRAINING}
    assert mesh.cloud.stats.carried == frozenset()
    mesh.wait_carried()


def test_stopping_the_robot_with_requests_in_flight(mesh: Mesh) -> None:
    mesh.faults.delay_s = lambda: 0.3
    mesh.start()
    mesh.serve("--plan", "/plan")
    mesh.wait_carried("/plan")
    mesh.call("/plan", "--count", "50", "--timeout-s", "1")
    wait_until(lambda: mesh.robot.stats.pending == 50, "50 requests on their way")
    assert mesh.robot.stop()
    assert not mesh.robot.alive
    assert mesh.link.carried == frozenset()
    assert mesh.robot.stats.pending == 0


def test_stopped_at_once_or_never_started(mesh: Mesh) -> None:
    threads = threading.active_count()
    mesh.robot.start(mesh.link.robot)
    assert mesh.robot.alive
    assert mesh.robot.stop()
    assert mesh.robot.stop()
    assert RosBridge(name="idle", role=Role.CLOUD, rules=()).stop()
    assert threading.active_count() == threads
    with pytest.raises(RuntimeError, match="already been started"):
        mesh.robot.start(mesh.link.robot)


@pytest.mark.parametrize("by", [signal.SIGTERM, signal.SIGINT])
def test_signals_are_the_programs_own(by: signal.Signals, ros_domain: int, tmp_path: Path) -> None:
    with Program("host", ["-m", "tests.ros.bridge_host"], ros_domain, tmp_path) as host:
        wait_until(lambda: "ready" in host.output(), f"the host: {host.output()}")
        assert host.stop(by) == 0, host.output()
        assert host.output().split() == ["ready", by.name, "stopped"]
    assert not (tmp_path / "ros-logs").exists(), "ROS wrote a log of its own"
