"""The ROS environment of the sidecar's unit: reaches applications of other users, and stays on the host."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.ros

DEPLOY = Path(__file__).parents[2] / "deploy"
PROBE = Path(__file__).with_name("dds_probe.py")
CALLS = 10
APPLICATION_USER = 60001
SIDECAR_USER = 60002


def base_environment(tmp_path: Path, domain: int) -> dict[str, str]:
    logs = tmp_path / "ros-logs"
    logs.mkdir(exist_ok=True)
    logs.chmod(0o777)
    return {"PATH": os.environ["PATH"], "ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": str(logs)}


def unit_environment() -> dict[str, str]:
    """The ROS variables that the unit sets, with its profile at its place in this repository."""
    unit = (DEPLOY / "systemd" / "plr-sidecar.service").read_text()
    settings = dict(re.findall(r"^Environment=(\w+)=(.*)$", unit, re.MULTILINE))
    assert settings["FASTRTPS_DEFAULT_PROFILES_FILE"] == "/etc/plr/fastdds.xml"
    return {
        "RMW_IMPLEMENTATION": settings["RMW_IMPLEMENTATION"],
        "ROS_AUTOMATIC_DISCOVERY_RANGE": settings["ROS_AUTOMATIC_DISCOVERY_RANGE"],
        "FASTRTPS_DEFAULT_PROFILES_FILE": str(DEPLOY / "config" / "fastdds.xml"),
    }


def as_user(uid: int) -> list[str]:
    """Run as another user who may read everything (an interpreter in a private home), but write nothing."""
    capability = "+dac_read_search"
    return [
        "setpriv",
        *(f"--reuid={uid}", f"--regid={uid}", "--clear-groups"),
        *(f"--inh-caps={capability}", f"--ambient-caps={capability}"),
    ]


@pytest.mark.skipif(os.geteuid() != 0, reason="becoming another user takes root")
@pytest.mark.parametrize("application_range", ["LOCALHOST", "SUBNET"])
def test_the_sidecar_calls_an_application_of_another_user(tmp_path: Path, application_range: str) -> None:
    environment = base_environment(tmp_path, 141 if application_range == "LOCALHOST" else 142)
    application = subprocess.Popen(
        [*as_user(APPLICATION_USER), sys.executable, PROBE, "serve"],
        env=environment | {"ROS_AUTOMATIC_DISCOVERY_RANGE": application_range},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    with application:
        try:
            assert application.stdout
            assert application.stdout.readline() == "ready\n"
            sidecar = subprocess.run(
                [*as_user(SIDECAR_USER), sys.executable, PROBE, "call", str(CALLS)],
                env=environment | unit_environment(),
                capture_output=True,
                text=True,
                timeout=60,
            )
            # The end of its input ends it, so that it takes its shared memory with it.
            application.communicate(timeout=30)
        finally:
            application.kill()
    assert f"answered {CALLS}" in sidecar.stdout, sidecar.stderr


def packets_that_left(tmp_path: Path, domain: int, settings: dict[str, str]) -> int:
    unshare = ["unshare", "--net"] if os.geteuid() == 0 else ["unshare", "--net", "--map-root-user"]
    run = subprocess.run(
        [*unshare, sys.executable, PROBE, "sniff", "3"],
        env=base_environment(tmp_path, domain) | settings,
        capture_output=True,
        text=True,
        timeout=60,
    )
    found = re.search(r"^left (\d+)$", run.stdout, re.MULTILINE)
    assert found, run.stderr
    return int(found[1])


@pytest.mark.netns
def test_nothing_of_ros_leaves_the_host(tmp_path: Path) -> None:
    assert packets_that_left(tmp_path, 143, unit_environment()) == 0


@pytest.mark.netns
def test_the_sniffer_would_notice(tmp_path: Path) -> None:
    assert packets_that_left(tmp_path, 144, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}) > 0
