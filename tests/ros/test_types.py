"""Service types by name, and bytes that are no message of theirs."""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import pytest
from geometry_msgs.msg import PoseStamped
from nav_msgs.srv import GetPlan
from rclpy.serialization import deserialize_message, serialize_message
from std_srvs.srv import SetBool

from plr.sidecar.ros.errors import RosBridgeError
from plr.sidecar.ros.types import TypeNotInstalledError, load_service_type
from tests.ros.processes import ROOT

pytestmark = pytest.mark.ros


def test_a_type_that_is_installed() -> None:
    found = load_service_type("nav_msgs/srv/GetPlan")
    assert found.service is GetPlan
    assert (found.request.name, found.response.name) == ("GetPlan_Request", "GetPlan_Response")


@pytest.mark.parametrize(
    "name",
    ["", "os", "os/system", "nav_msgs/msg/Path", "nav_msgs/action/X", "nav_msgs/srv/GetPlan/x", "a.b/srv/C", "é/srv/C"],
)
def test_a_name_that_is_no_service_type(name: str) -> None:
    with pytest.raises(RosBridgeError, match="not a service type"):
        load_service_type(name)


@pytest.mark.parametrize("name", ["nowhere_msgs/srv/Thing", "nav_msgs/srv/Nothing", "os/srv/Path"])
def test_a_type_that_is_not_installed(name: str) -> None:
    with pytest.raises(TypeNotInstalledError, match=f"install the ROS package '{name.split('/')[0]}'"):
        load_service_type(name)


def test_bytes_and_back() -> None:
    response_type = load_service_type("nav_msgs/srv/GetPlan").response
    response = GetPlan.Response()
    response.plan.header.frame_id = "map \U0001f5fa"
    response.plan.poses = [PoseStamped() for _ in range(300)]
    response.plan.poses[299].pose.position.x = 0.25
    payload = serialize_message(response)
    for received in (payload, payload + b"trailing"):
        again = response_type.serialize(response_type.deserialize(received))
        assert deserialize_message(again, GetPlan.Response) == response


def test_padding_holds_nothing_of_earlier_messages() -> None:
    """Fast CDR leaves padding unwritten, and the next message goes to another peer."""
    kind = load_service_type("std_srvs/srv/SetBool").response
    secret = kind.deserialize(serialize_message(SetBool.Response(message="s" * 100)))
    plain = kind.deserialize(serialize_message(SetBool.Response(success=True, message="")))
    first = kind.serialize(plain)
    kind.serialize(secret)
    assert kind.serialize(plain) == first
    assert b"s" not in first


def test_messages_are_freed() -> None:
    kind = load_service_type("nav_msgs/srv/GetPlan").response
    response = GetPlan.Response()
    response.plan.poses = [PoseStamped() for _ in range(1000)]
    payload = serialize_message(response)

    def resident_bytes() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()

    for _ in range(20):
        kind.serialize(kind.deserialize(payload))
    before = resident_bytes()
    for _ in range(500):  # 36 MB of bytes, more as messages
        kind.serialize(kind.deserialize(payload))
    assert resident_bytes() - before < 10_000_000


@pytest.mark.audit("sec-3")
@pytest.mark.parametrize("seed", range(3))
def test_hostile_bytes(seed: int) -> None:
    """In a process of its own, with little memory: a crash or a huge allocation would take the sidecar with it."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.ros.hostile_bytes", str(seed), "4000", "200"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0, (done.returncode, done.stdout, done.stderr[-2000:])
    accepted, refused, slowest_s = map(float, done.stdout.split())
    assert accepted + refused == 4200
    assert slowest_s < 5, "generous for a busy machine: without the walk 14 s and more"
    assert accepted > 100
    assert refused > 1000
