"""Programs of the running system are killed and come back: no request is lost.

The tests run in order and say what they leave behind.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.netns.two_clouds import CLOUDS, DEADLINE_MS, ROBOT_SERVICES, make_links_good, start_cloud, two_clouds
from tests.support.calling import Call, assert_flawless, counter

if TYPE_CHECKING:
    from collections.abc import Iterator

    from lab.system import System

pytestmark = [pytest.mark.netns, pytest.mark.ros, pytest.mark.timeout(180)]


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    """One running system for the whole file."""
    with two_clouds(tmp_path_factory.mktemp("system")) as running:
        yield running


@pytest.fixture(autouse=True)
def good_links(system: System) -> None:
    """Every test starts with both links good."""
    make_links_good(system)


def test_the_control_plane_killed_and_a_robot_restarted_without_it(system: System) -> None:
    call = Call(system, "--duration", "5", "--rate", "20")
    call.wait_until_sending()
    system.parts["controlplane"].kill()
    assert_flawless(call.result())
    before = system.parts["robot.sidecar"]
    assert before.terminate() == 0
    before.log.unlink()
    robot = system.start_robot(ROBOT_SERVICES)
    system.wait_for_offer(robot, services=2)
    assert_flawless(Call(system, "--duration", "3", "--rate", "20").result())
    call = Call(system, "--duration", "6", "--rate", "20")
    call.wait_until_sending()
    system.start_control_plane()
    system.wait("the robot to register", lambda: "registered with the control plane" in robot.log.read_text())
    assert_flawless(call.result())


@pytest.mark.parametrize("cloud", CLOUDS)
def test_a_cloud_killed_and_brought_back(system: System, cloud: str) -> None:
    call = Call(system, "--duration", "8", "--rate", "20")
    call.wait_until_sending()
    for part in ("echo", "planner", "sidecar"):
        system.parts[f"{cloud}.{part}"].kill()
    assert_flawless(call.result())
    start_cloud(system, cloud)
    name = cloud.replace("_", "-")
    system.wait(f"{cloud} to be reached", lambda: counter(system, "plr_path_up", peer=name) == 2)


def test_only_the_ros_server_killed(system: System) -> None:
    call = Call(system, "--duration", "6", "--rate", "20")
    call.wait_until_sending()
    system.parts["cloud_a.echo"].kill()
    assert_flawless(call.result())


def test_a_slow_server_beside_a_fast_one(system: System) -> None:
    """cloud_a, without echo server since the test before, gets one that needs longer than the deadline."""
    argv = ["-m", "lab.echo", "serve", "--delay-ms", "700", "--delay-every", "1"]
    system.start_node("cloud_a.echo", "cloud_a", argv)
    system.wait("cloud_a to offer /echo", lambda: "/echo" in system.parts["cloud_a.sidecar"].log.read_text()[-2000:])
    run = Call(system, "--duration", "4", "--rate", "5").result()
    assert_flawless(run)
    assert run["summary"]["p50_ms"] < DEADLINE_MS


def test_sigterm_ends_every_program_cleanly(system: System) -> None:
    for name in ("robot.sidecar", "cloud_a.sidecar", "cloud_b.sidecar", "controlplane"):
        part = system.parts[name]
        assert part.terminate() == 0, part.tail()
        assert "Traceback" not in part.log.read_text()
