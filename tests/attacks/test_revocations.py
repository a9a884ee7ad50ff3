"""A revocation while no control plane runs: the list that one cloud is given reaches the others over the data plane."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.ca.files import write_atomically
from plr.protos.program.tls_files import CRL_FILE
from tests.attacks.world import SERVICES

if TYPE_CHECKING:
    from tests.attacks.world import World

pytestmark = [pytest.mark.netns, pytest.mark.ros, pytest.mark.timeout(240), pytest.mark.audit("sec-12")]

ROBOT_2, ROBOT_3 = "robot-2", "robot-3"
SOON_S = 30.0
"""Telling, asking, sending and judging take about 1 s from a sidecar to the next: generous for a busy machine."""


def numbers(world: World, host: str) -> list[float]:
    """The numbers of the revocation lists that a sidecar uses, one for each CA."""
    metrics = world.system.metrics(host)
    return [number for name, number in metrics.items() if name.startswith("plr_revocation_list_number")]


def test_a_robot_that_demands_a_fresh_list_talks_to_nobody_without_one(world: World) -> None:
    """The fleet's first list is as old as its CA, which begins five minutes in the past."""
    system = world.system
    robot = system.start_robot(SERVICES, name=ROBOT_3, host="robot_2", interfaces=["eth9"], max_revocation_age_s=120)
    refused = re.compile(
        r"cloud-a is refused, although the control plane names it as a peer: its CA's revocation list was"
    )
    system.wait("it to refuse its peers", lambda: refused.search(robot.log.read_text()) is not None)
    assert "are older than max_revocation_age_s (120 s) by this clock" in robot.log.read_text()
    assert world.counter("robot_2", "plr_revocation_lists_too_old") == 1
    assert world.counter("robot_2", "plr_path_up") == 0
    system.authority.publish()
    write_atomically(world.tls_dir("control") / CRL_FILE, system.authority.crl_pem(), 0o644)
    system.wait("its paths", lambda: world.counter("robot_2", "plr_path_up") == 2, SOON_S)
    system.wait("it to say so", lambda: world.counter("robot_2", "plr_revocation_lists_too_old") == 0, SOON_S)
    assert robot.terminate() == 0


def test_a_list_that_one_cloud_is_given_revokes_at_all(world: World) -> None:
    system = world.system
    system.start_robot(SERVICES, name=ROBOT_2, host="robot_2", interfaces=["eth9"])
    clouds = ("cloud_a", "cloud_b")

    def paths(cloud: str) -> float:
        return world.counter(cloud, "plr_path_up", peer=ROBOT_2)

    system.wait("both clouds to have paths", lambda: all(paths(cloud) == 1 for cloud in clouds))
    with world.calls():
        system.parts["controlplane"].kill()
        system.authority.revoke(ROBOT_2)
        (only,) = numbers(world, "cloud_b")
        write_atomically(world.tls_dir("cloud-a") / CRL_FILE, system.authority.crl_pem(), 0o644)
        system.wait("cloud_a to part with it", lambda: paths("cloud_a") == 0, SOON_S)
        system.wait("cloud_b to part with it", lambda: paths("cloud_b") == 0, SOON_S)
        for host in ("cloud_a", "cloud_b", "robot"):
            system.wait(f"{host} to hold it", lambda host=host: numbers(world, host) == [only + 1], SOON_S)  # type: ignore[misc]
        log = system.parts["cloud_b.sidecar"].log.read_text()
        assert re.search(r"took a new revocation list from robot(-2)?: number", log)
        assert re.search(f"{ROBOT_2} is refused, although the control plane names it as a peer: .*revoked", log)
        for cloud in clouds:
            assert world.counter(cloud, "plr_path_up", peer="robot") == 1
        # It holds over a restart, also without control plane and folder.
        cloud_b = system.parts["cloud_b.sidecar"]
        assert cloud_b.terminate() == 0
        system.start_cloud("cloud_b", [{"name": "/echo"}, {"name": "/plan_path"}])
        system.wait("cloud_b to hold it still", lambda: numbers(world, "cloud_b") == [only + 1], SOON_S)
    assert world.end_calls() > 0
