"""The whole system over the lab: unmodified ROS programs, two NATed interfaces, two clouds, everything real."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from lab import Lab, LabConfig, LinkProfile
from lab.echo import journal_ids
from lab.system import Part, System

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

CLOUDS = ("cloud_a", "cloud_b")
DEADLINE_MS = 500
CLOUD_SERVICES = [{"name": "/echo"}, {"name": "/plan_path"}, {"name": "/detect_*"}]
ROBOT_SERVICES = [
    {"name": "/echo", "deadline_ms": DEADLINE_MS, "lifetime_ms": 30_000, "idempotent": True},
    {"name": "/plan_path", "deadline_ms": DEADLINE_MS, "lifetime_ms": 30_000, "idempotent": True},
    {"name": "/detect_people", "deadline_ms": 1000, "lifetime_ms": 30_000, "idempotent": True},
]
WLAN = LinkProfile(delay_ms=5, jitter_ms=2)
WWAN = LinkProfile(delay_ms=15, jitter_ms=5)


@contextlib.contextmanager
def two_clouds(folder: Path) -> Iterator[System]:
    """Control plane, two clouds with two servers each, a robot's sidecar that offers both services."""
    with Lab(LabConfig.of(interfaces=("wlan0", "wwan0"), clouds=2), seed=1) as lab:
        running = System(lab, folder)
        running.start_control_plane()
        for cloud in CLOUDS:
            start_cloud(running, cloud)
        robot = running.start_robot(ROBOT_SERVICES)
        running.wait_for_offer(robot, services=2)
        yield running
        running.close()


def make_links_good(system: System) -> None:
    """Both links as every test finds them."""
    for name, profile in (("wlan0", WLAN), ("wwan0", WWAN)):
        system.lab.link(name).reset()
        system.lab.link(name).set(profile)


def start_cloud(system: System, cloud: str, *server_options: str) -> None:
    """Start the servers and the sidecar of a cloud."""
    journal = str(system.folder / f"{cloud}.journal")
    argv = ["-m", "lab.echo", "serve", "--journal", journal, *server_options]
    system.start_node(f"{cloud}.echo", cloud, argv)
    system.start_node(f"{cloud}.planner", cloud, ["-m", "examples.motion_planning.server"])
    system.start_cloud(cloud, CLOUD_SERVICES)


def offered(robot: Part, service: str) -> bool:
    """Whether a robot's sidecar has ever offered the service, by its log."""
    return any(service in line and " is offered here" in line for line in robot.log.read_text().splitlines())


def executed(folder: Path) -> dict[str, list[str]]:
    """Which requests each cloud's server ran."""
    return {cloud: journal_ids(folder / f"{cloud}.journal") for cloud in CLOUDS}
