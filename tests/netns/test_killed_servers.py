"""A ROS server killed without a word, of a service whose requests may run only once: what it had is lost, nothing else.

DDS itself believes it alive for the 20 s of its lease.
"""

from __future__ import annotations

import itertools
import sys
import time
from typing import TYPE_CHECKING

import pytest

from lab import Lab, LabConfig
from lab.system import System
from tests.netns.two_clouds import CLOUDS, executed, make_links_good
from tests.support.calling import Call

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = [pytest.mark.netns, pytest.mark.ros, pytest.mark.timeout(180), pytest.mark.audit("dp-15")]

SERVICE = {"name": "/echo", "deadline_ms": 500, "lifetime_ms": 30_000, "idempotent": False}
LEASE_S = 20.0
AT_LEAST = 20
"""Requests of which the server that is killed ran so many before."""
AT_THE_SERVER = 2
"""Requests that it may have had: one in work, and one that is there when that is done."""


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    with Lab(LabConfig.of(interfaces=("wlan0", "wwan0"), clouds=2), seed=1) as lab:
        running = System(lab, tmp_path_factory.mktemp("killed"))
        make_links_good(running)
        running.start_control_plane()
        for cloud in CLOUDS:
            running.start_cloud(cloud, [{"name": "/echo"}])
        running.start_robot([SERVICE])
        yield running
        running.close()


def serve(system: System, cloud: str, *before: str) -> None:
    """Start a server and wait until the robot may use it; `before`: what starts it in turn."""
    log = system.parts[f"{cloud}.sidecar"].log
    times = offers(log.read_text())
    argv = ["-m", "lab.echo", "serve", "--delay-ms", "30", "--delay-every", "1"]
    journal = ["--journal", str(system.folder / f"{cloud}.journal")]
    system.start_node(f"{cloud}.echo", cloud, [*before, *argv, *journal])
    system.wait(f"{cloud} to offer /echo", lambda: offers(log.read_text()) > times)


def offers(log: str) -> int:
    return sum("/echo" in line and "is offered to robots" in line for line in log.splitlines())


@pytest.mark.parametrize("where", ["on the host", "in a container"])
def test_a_server_killed_under_requests_that_may_run_only_once(system: System, where: str) -> None:
    inside = ["-m", "tests.support.in_a_namespace", sys.executable] if where == "in a container" else []
    for cloud in CLOUDS:
        serve(system, cloud, *inside)
    system.wait_for_offer(system.parts["robot.sidecar"])
    before = executed(system.folder)
    call = Call(system, "--duration", "10", "--rate", "20")
    call.wait_until_sending()
    system.wait("a server to be asked", lambda: max(map(len, newly_run(system, before).values())) >= AT_LEAST)
    asked = {cloud: len(ids) for cloud, ids in newly_run(system, before).items()}
    victim = max(CLOUDS, key=asked.__getitem__)
    system.parts[f"{victim}.echo"].kill()
    killed_at = time.monotonic()
    run = call.result()
    del system.parts["client"]  # it ends with 1: a request is lost
    summary = run["summary"]
    assert summary["missing"] <= AT_THE_SERVER, summary
    assert summary["answered_twice"] == summary["invalid"] == summary["strangers"] == 0, summary
    rescued = [one["latency_ms"] for one in run["requests"] if one["answers"] and one["sent_s"] > killed_at - 0.1]
    assert max(rescued) < LEASE_S / 2 * 1e3, summary
    ran = list(itertools.chain(*newly_run(system, before).values()))
    assert len(ran) == len(set(ran)), "some request ran twice"
    for cloud in CLOUDS:
        if cloud != victim:
            system.parts[f"{cloud}.echo"].kill()


def newly_run(system: System, before: dict[str, list[str]]) -> dict[str, list[str]]:
    return {cloud: ids[len(before[cloud]) :] for cloud, ids in executed(system.folder).items()}
