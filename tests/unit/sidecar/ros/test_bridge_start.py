"""ROS that does not start at first: the bridge says so in one line and tries again."""

from __future__ import annotations

import os
import time
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest

from plr.protos.model.ids import Role
from plr.sidecar.ros.environment import LAST_SECOND, not_started
from plr.sidecar.ros.errors import RosStartError

if TYPE_CHECKING:
    from collections.abc import Iterator

pytest.importorskip("rclpy")

from plr.sidecar.ros import bridge as module

pytestmark = pytest.mark.audit("ops-4")


class Loop:
    """A loop that cannot be made `refusals` times."""

    refusals = 0
    graph_changed = False
    domain_id = 0
    node = SimpleNamespace(get_fully_qualified_name=lambda: "/x")
    handle = None

    def __init__(self, *_: object) -> None:
        if Loop.refusals > 0:
            Loop.refusals -= 1
            raise RosStartError("the clock says 2039-01-01; set it")

    def wait(self, _timeout_s: float) -> list[Any]:
        time.sleep(0.001)
        return []

    def wake(self) -> None:
        pass

    def close(self) -> None:
        pass


class Side:
    scan_is_due = False

    def settling(self) -> bool:
        return False

    def scan(self) -> Iterator[None]:
        return iter(())

    def next_due(self) -> None:
        return None

    def on_timer(self, now: float) -> None:
        pass

    def close(self) -> None:
        pass


@pytest.fixture
def bridge(monkeypatch: pytest.MonkeyPatch) -> module.RosBridge:
    monkeypatch.setattr(module, "RosLoop", Loop)
    monkeypatch.setattr(module, "START_AGAIN_S", 0.01)
    made = module.RosBridge(name="robot", role=Role.ROBOT, rules=())
    monkeypatch.setattr(made, "_make_side", lambda *_: Side())
    return made


def test_it_is_tried_again_and_told_once(bridge: module.RosBridge, caplog: pytest.LogCaptureFixture) -> None:
    Loop.refusals = 3
    data_plane: Any = None
    bridge.start(data_plane)
    assert bridge.stats.not_started == "the clock says 2039-01-01; set it"
    end = time.monotonic() + 20.0
    while bridge.stats.not_started and time.monotonic() < end:
        time.sleep(0.01)
    assert (bridge.stats.not_started, bridge.alive) == ("", True)
    assert bridge.stop()
    (line,) = [one for one in caplog.records if one.levelname == "ERROR"]
    assert (line.exc_info, line.getMessage().startswith("the clock says 2039-01-01; set it (tried again")) == (
        None,
        True,
    )


def test_it_stops_while_it_waits(bridge: module.RosBridge, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "START_AGAIN_S", 3600.0)
    Loop.refusals = 1
    data_plane: Any = None
    bridge.start(data_plane)
    assert bridge.stop()
    assert not bridge.alive


def test_peers_without_an_address_are_left_out_before_ros_starts(
    bridge: module.RosBridge, monkeypatch: pytest.MonkeyPatch
) -> None:
    Loop.refusals = 0
    monkeypatch.setenv("ROS_STATIC_PEERS", "127.0.0.1;nowhere.invalid")
    data_plane: Any = None
    bridge.start(data_plane)
    assert bridge.stop()
    assert bridge.stats.left_out_peers == ("nowhere.invalid",)
    assert os.environ["ROS_STATIC_PEERS"] == "127.0.0.1"


def test_why_ros_does_not_start() -> None:
    said = "error creating node: cannot publish data, at /x/rmw_publish.cpp:66\n, at node.c:252"
    assert not_started(said, LAST_SECOND - 1.0) == (
        "ROS 2 does not start here: error creating node: cannot publish data, at /x/rmw_publish.cpp:66 , at node.c:252"
    )
    assert not_started(said, 2177452801.0) == (
        "the clock says 2039-01-01, and Fast DDS works only until 2038-01-19; "
        "set it: timedatectl set-ntp true, or date -s"
    )
