"""A robot that loses its control plane alone, and then its data links for a while, is answered when they are back."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import pytest

from lab import Lab, LabConfig
from lab.system import System
from plr.sidecar.doctor import removed_peers
from plr.sidecar.local.client import LocalClient
from tests.netns.two_clouds import CLOUD_SERVICES, ROBOT_SERVICES
from tests.support.calling import Call, assert_flawless, counter

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = [pytest.mark.netns, pytest.mark.ros, pytest.mark.timeout(240)]

INTERFACES = ("wlan0", "wwan0")
DARK_S = 30.0


@pytest.fixture
def system(tmp_path: Path) -> Iterator[System]:
    with Lab(LabConfig.of(interfaces=INTERFACES, clouds=1), seed=1) as lab:
        running = System(lab, tmp_path)
        running.start_control_plane()
        running.start_node("cloud_a.echo", "cloud_a", ["-m", "lab.echo", "serve"])
        running.start_cloud("cloud_a", CLOUD_SERVICES, local_socket=str(tmp_path / "cloud.socket"))
        robot = running.start_robot(ROBOT_SERVICES)
        running.wait_for_offer(robot)
        yield running
        running.close()


def removed(system: System) -> list[dict[str, Any]]:
    """The peers that the control plane removed, as the cloud tells the doctor."""
    with LocalClient(system.folder / "cloud.socket") as client:
        told: list[dict[str, Any]] = client.state()["removed_peers"]
    return told


def test_a_robot_without_its_control_plane_survives_a_tunnel(system: System) -> None:
    system.lab.host("robot").ip_batch([f"route add blackhole {system.lab.host('control').address()}/32"])
    call = Call(system, "--duration", "12", "--rate", "10")
    log = system.parts["controlplane"].log
    system.wait("the robot's lease to end", lambda: "robot is gone: lease_expired" in log.read_text())
    assert_flawless(call.result())
    (told,) = removed(system)
    assert (told["name"], told["reason"], told["kept"]) == ("robot", "lease_expired", "path")
    for interface in INTERFACES:
        system.lab.link(interface).blackhole()
    time.sleep(DARK_S)
    (told,) = removed(system)
    assert told["kept"] == "dormant"
    (finding,) = removed_peers.findings({"removed_peers": [told]})
    assert "its lease expired" in finding.text
    for interface in INTERFACES:
        system.lab.link(interface).restore()
    system.wait("both paths", lambda: counter(system, "plr_path_up", peer="cloud-a") == len(INTERFACES))
    assert_flawless(Call(system, "--duration", "5", "--rate", "20").result())
    assert "registered" not in system.parts["robot.sidecar"].log.read_text().partition(" lost: ")[2]
