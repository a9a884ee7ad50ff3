"""ROS processes that stand still for longer than DDS's lease, as in a paused virtual machine, and then go on."""

from __future__ import annotations

import logging
import signal
from typing import TYPE_CHECKING

import pytest

from tests.ros.mesh import wait_until

if TYPE_CHECKING:
    from sidecar.ros.bridge import RosBridge
    from tests.ros.mesh import Mesh

pytestmark = pytest.mark.ros

UNKNOWN = "_NODE_NAME_UNKNOWN_"
LEASE = """<?xml version="1.0" encoding="UTF-8"?>
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <participant profile_name="short_lease" is_default_profile="true">
    <rtps>
      <builtin>
        <discovery_config>
          <leaseDuration><sec>2</sec></leaseDuration>
          <leaseAnnouncement><sec>0</sec><nanosec>400000000</nanosec></leaseAnnouncement>
        </discovery_config>
      </builtin>
    </rtps>
  </participant>
</profiles>
"""


@pytest.fixture
def short_lease(mesh: Mesh) -> None:
    """Of the programs around the bridges: 2 s instead of 20 s."""
    profile = mesh.folder / "short_lease.xml"
    profile.write_text(LEASE)
    mesh.environment["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(profile)
    # As sidecars talk to them. With shared memory a process that was stopped does not always come back in Fast DDS.
    mesh.environment["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"


def nodes(bridge: RosBridge, service: str) -> dict[bytes, str]:
    """The endpoints that answer for it, and their nodes' names as rmw knows them."""
    assert bridge._loop is not None
    found = bridge._loop.node.get_publishers_info_by_topic(f"rr{service}Reply", no_mangle=True)
    return {bytes(info.endpoint_gid): info.node_name for info in found}


def wait_known(bridge: RosBridge, service: str, node: str) -> None:
    """Wait until rmw knows exactly this node."""
    wait_until(lambda: list(nodes(bridge, service).values()) == [node], f"the node {node}")


@pytest.mark.usefixtures("short_lease")
def test_a_server_that_stood_still_is_offered_again_and_a_sidecar_is_not(
    mesh: Mesh, caplog: pytest.LogCaptureFixture
) -> None:
    """What rmw does not know the node of may be either; a sidecar's proxy must not be offered on."""
    caplog.set_level(logging.INFO, "sidecar")
    mesh.start()
    sidecar = mesh.run(mesh.cloud_domain, "/elsewhere", "std_srvs/srv/Trigger", module="tests.ros.proxy_host")
    server = mesh.serve("--plan", "/plan")
    mesh.wait_carried("/plan")
    wait_known(mesh.cloud, "/plan", "test_server")
    wait_known(mesh.cloud, "/elsewhere", "_plr_sidecar_other_robot")
    for program in (server, sidecar):
        program.send(signal.SIGSTOP)
    wait_until(lambda: not nodes(mesh.cloud, "/plan") and not nodes(mesh.cloud, "/elsewhere"), "the leases' ends")
    mesh.wait_carried()
    for program in (server, sidecar):
        program.send(signal.SIGCONT)
    mesh.wait_carried("/plan")
    wait_until(lambda: "/_plr_sidecar_other_robot" in caplog.text, "the sidecar's name")
    # The name is there in time for the next look.
    scans = mesh.cloud.stats.scans
    wait_until(lambda: mesh.cloud.stats.scans > scans, "another look")
    assert mesh.result(mesh.call("/plan", "--count", "5"))["answered"] == 5
    wait_known(mesh.cloud, "/plan", UNKNOWN)
    wait_known(mesh.cloud, "/elsewhere", UNKNOWN)
    offered = [record.getMessage() for record in caplog.records if "is offered to robots" in record.msg]
    assert offered == ["service /plan (nav_msgs/srv/GetPlan) is offered to robots"] * 2


@pytest.mark.usefixtures("short_lease")
def test_a_local_server_that_stood_still_is_left_alone_again(mesh: Mesh) -> None:
    mesh.start()
    own = mesh.serve("--plan", "/plan", "--node", "own_planner", domain=mesh.robot_domain)
    mesh.serve("--plan", "/plan", "--negate", "/negate")
    mesh.wait_carried("/negate")
    wait_known(mesh.robot, "/plan", "own_planner")
    own.send(signal.SIGSTOP)
    mesh.wait_carried("/negate", "/plan")
    own.send(signal.SIGCONT)
    mesh.wait_carried("/negate")
    assert mesh.robot.stats.left_alone == {"/plan": ("/own_planner",)}
    wait_known(mesh.robot, "/plan", UNKNOWN)
