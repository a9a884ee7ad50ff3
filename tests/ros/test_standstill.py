"""ROS processes that stand still for longer than DDS's lease, as in a paused virtual machine, and then go on."""

from __future__ import annotations

import logging
import signal
import time
from typing import TYPE_CHECKING

import pytest

from tests.ros.mesh import POLL_S, wait_until

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.sidecar.ros.bridge import RosBridge
    from tests.ros.mesh import Mesh
    from tests.ros.processes import Program

pytestmark = pytest.mark.ros

TRIES = 4
LIVED_S = 4.0
"""Of those that lived so long all came back."""
SEEN_AGAIN_S = 5.0
"""As a rule it takes 0.2 s."""
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
    mesh.environment["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"  # as sidecars talk to them


def nodes(bridge: RosBridge, service: str) -> dict[bytes, str]:
    """The endpoints that answer for it, and their nodes' names as rmw knows them."""
    assert bridge._loop is not None
    found = bridge._loop.node.get_publishers_info_by_topic(f"rr{service}Reply", no_mangle=True)
    return {bytes(info.endpoint_gid): info.node_name for info in found}


def wait_known(bridge: RosBridge, service: str, node: str) -> None:
    """Wait until rmw knows exactly this node."""
    wait_until(lambda: list(nodes(bridge, service).values()) == [node], f"the node {node}")


def come_back(
    bridge: RosBridge, start: Callable[[], Program], service: str, node: str, while_gone: Callable[[], object] = bool
) -> None:
    """Start a program that serves it, stop it until its lease is over, let it go on, and wait until rmw sees it again.

    Fast DDS permanently loses many that had started a second before, or half of their endpoints (also plain servers,
    and with its lease of 20 s). One that shows nothing is lost, and another one is started.
    """
    for _ in range(TRIES):
        program = start()
        settled_at = time.monotonic() + LIVED_S
        wait_known(bridge, service, node)
        time.sleep(max(0.0, settled_at - time.monotonic()))
        program.send(signal.SIGSTOP)
        wait_until(lambda: not nodes(bridge, service), "the end of the lease")
        while_gone()
        program.send(signal.SIGCONT)
        end = time.monotonic() + SEEN_AGAIN_S
        while time.monotonic() < end:
            if nodes(bridge, service):
                return
            time.sleep(POLL_S)
        program.stop(signal.SIGKILL)
    pytest.fail("Fast DDS finds none of them again")


@pytest.mark.usefixtures("short_lease")
def test_a_server_that_stood_still_is_offered_again(mesh: Mesh) -> None:
    mesh.start()
    come_back(mesh.cloud, lambda: mesh.serve("--plan", "/plan"), "/plan", "test_server", mesh.wait_carried)
    mesh.wait_carried("/plan")
    assert mesh.result(mesh.call("/plan", "--count", "5"))["answered"] == 5
    wait_known(mesh.cloud, "/plan", UNKNOWN)


@pytest.mark.usefixtures("short_lease")
def test_a_sidecar_that_stood_still_is_no_application(mesh: Mesh, caplog: pytest.LogCaptureFixture) -> None:
    """Its proxy is not offered on, neither while nothing is known of it nor after."""
    caplog.set_level(logging.INFO, "plr.sidecar")
    mesh.cloud.start(mesh.link.cloud)

    def start() -> Program:
        return mesh.run(mesh.cloud_domain, "/elsewhere", "std_srvs/srv/Trigger", module="tests.ros.proxy_host")

    come_back(mesh.cloud, start, "/elsewhere", "_plr_sidecar_other_robot")
    wait_until(lambda: "/_plr_sidecar_other_robot" in caplog.text, "the sidecar's name")
    # The name is there in time for the next scan.
    scans = mesh.cloud.stats.scans
    wait_until(lambda: mesh.cloud.stats.scans > scans, "another scan")
    wait_known(mesh.cloud, "/elsewhere", UNKNOWN)
    assert not [record for record in caplog.records if "is offered to robots" in record.msg]


@pytest.mark.usefixtures("short_lease")
def test_a_local_server_that_stood_still_is_left_alone_again(mesh: Mesh) -> None:
    mesh.start()
    mesh.serve("--plan", "/plan", "--negate", "/negate")
    mesh.wait_carried("/plan", "/negate")
    own = "own_planner"
    servers = ("--plan", "/own", "--plan", "/plan", "--node", own)

    def start() -> Program:
        return mesh.serve(*servers, domain=mesh.robot_domain)

    come_back(mesh.robot, start, "/own", own, lambda: mesh.wait_carried("/negate", "/plan"))
    mesh.wait_carried("/negate")
    assert mesh.robot.stats.left_alone == {"/plan": ("/own_planner",)}
    wait_known(mesh.robot, "/own", UNKNOWN)
