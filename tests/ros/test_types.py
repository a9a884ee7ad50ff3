"""Service types by name, and bytes that are no message of theirs."""

from __future__ import annotations

import subprocess
import sys

import pytest
from nav_msgs.srv import GetPlan

from sidecar.ros.errors import RosBridgeError
from sidecar.ros.types import TypeNotInstalledError, deserialize, load_service_type, serialize
from tests.ros.processes import ROOT

pytestmark = pytest.mark.ros


def test_a_type_that_is_installed() -> None:
    found = load_service_type("nav_msgs/srv/GetPlan")
    assert (found.service, found.request, found.response) == (GetPlan, GetPlan.Request, GetPlan.Response)


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
    load_service_type("nav_msgs/srv/GetPlan")
    request = GetPlan.Request(tolerance=0.5)
    request.goal.header.frame_id = "map"
    payload = serialize(request, GetPlan.Request)
    assert deserialize(payload, GetPlan.Request) == request
    assert deserialize(payload + b"trailing", GetPlan.Request) == request


def test_what_cannot_be_serialised() -> None:
    load_service_type("nav_msgs/srv/GetPlan")
    request = GetPlan.Request()
    request.goal.header._frame_id = 7
    with pytest.raises(RosBridgeError, match="cannot serialise"):
        serialize(request, GetPlan.Request)


@pytest.mark.parametrize("seed", range(3))
def test_hostile_bytes(seed: int) -> None:
    """In a process of its own, with little memory: a crash or a huge allocation would take the sidecar with it."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.ros.hostile_bytes", str(seed), "4000"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0, (done.returncode, done.stdout, done.stderr[-2000:])
    accepted, refused = map(int, done.stdout.split())
    assert accepted + refused == 4000
    assert accepted > 100
    assert refused > 1000
