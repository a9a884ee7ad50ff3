"""The whole system over the lab: unmodified ROS programs, two NATed interfaces, two clouds, everything real.

The tests of this file share one running system and run in order; those that kill something come last and say what
they leave behind.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import pytest

from bench.echo import journal_ids
from bench.netlab import Lab, LabConfig, LinkProfile
from bench.system import Part, System
from tests.netns.calling import Call, assert_flawless, counter

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = [pytest.mark.netns, pytest.mark.ros, pytest.mark.timeout(180)]

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


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    """Control plane, two clouds with two servers each, a robot's sidecar that offers both services."""
    folder = tmp_path_factory.mktemp("system")
    with Lab(LabConfig.of(interfaces=("wlan0", "wwan0"), clouds=2), seed=1) as lab:
        running = System(lab, folder)
        running.start_control_plane()
        for cloud in CLOUDS:
            start_cloud(running, cloud)
        robot = running.start_robot(ROBOT_SERVICES)
        running.wait_for_offer(robot, services=2)
        yield running
        running.close()


@pytest.fixture(autouse=True)
def good_links(system: System) -> None:
    """Every test starts with both links good."""
    for name, profile in (("wlan0", WLAN), ("wwan0", WWAN)):
        system.lab.link(name).reset()
        system.lab.link(name).set(profile)


def start_cloud(system: System, cloud: str, *server_options: str) -> None:
    journal = str(system.folder / f"{cloud}.journal")
    argv = ["-m", "bench.echo", "serve", "--journal", journal, *server_options]
    system.start_node(f"{cloud}.echo", cloud, argv)
    system.start_node(f"{cloud}.planner", cloud, ["-m", "examples.motion_planning.server"])
    system.start_cloud(cloud, CLOUD_SERVICES)


def offered(robot: Part, service: str) -> bool:
    return any(service in line and " is offered here" in line for line in robot.log.read_text().splitlines())


def executed(folder: Path) -> dict[str, list[str]]:
    return {cloud: journal_ids(folder / f"{cloud}.journal") for cloud in CLOUDS}


def test_a_standard_type_over_both_interfaces_to_both_servers(system: System) -> None:
    run = Call(system, "--duration", "4", module="examples.motion_planning.client").result()
    assert_flawless(run)
    assert counter(system, "plr_duplicate_responses_total") > 0


def test_a_custom_type_runs_at_most_once_on_each_server(system: System) -> None:
    for cloud in CLOUDS:
        (system.folder / f"{cloud}.journal").write_text("")
    assert_flawless(Call(system, "--duration", "4", "--rate", "20").result())
    for ids in executed(system.folder).values():
        assert ids
        assert len(ids) == len(set(ids))


def test_people_are_found_on_camera_frames_through_the_sidecars(system: System) -> None:
    """The second example: frames of about 145 kB. Its servers compute a lot and live for this test only."""
    servers = [system.start_node(f"{c}.detector", c, ["-m", "examples.human_detection.server"]) for c in CLOUDS]
    robot = system.parts["robot.sidecar"]
    system.wait("/detect_people to be offered", lambda: offered(robot, "/detect_people"))
    run = Call(system, "--duration", "4", "--rate", "5", module="examples.human_detection.client").result()
    assert_flawless(run)
    for server in servers:
        assert server.terminate() == 0
    system.wait("/detect_people to be withdrawn", lambda: "/detect_people is withdrawn" in robot.log.read_text())


def test_a_path_blackholed_silently_at_50_hz(system: System) -> None:
    call = Call(system, "--duration", "8", "--rate", "50", "--size", "1000")
    call.wait_until_sending()
    system.lab.link("wlan0").blackhole()
    run = call.result()
    assert_flawless(run)
    assert sum(system.lab.link("wlan0").stats().up.drops.values())


def test_both_paths_dark_for_two_seconds(system: System) -> None:
    call = Call(system, "--duration", "6", "--rate", "20")
    call.wait_until_sending()
    for name in ("wlan0", "wwan0"):
        system.lab.link(name).blackhole()
    time.sleep(2.0)
    for name in ("wlan0", "wwan0"):
        system.lab.link(name).restore()
    run = call.result()
    assert_flawless(run)
    assert run["summary"]["deadline_missed"] > 0


def test_150_kb_at_10_hz_with_2_percent_loss(system: System) -> None:
    for name in ("wlan0", "wwan0"):
        system.lab.link(name).change(loss=0.02)
    assert_flawless(Call(system, "--duration", "5", "--rate", "10", "--size", "150000").result())


def test_100_requests_in_flight_come_back_to_their_callers(system: System) -> None:
    """The servers take 10 ms each, one by one, so that the last of 150 is in flight for 1.5 s.

    The client keeps more answers than rclpy's default of 10, which a client that is slow for a moment overflows.
    """
    burst = ("--duration", "0.1", "--rate", "1500", "--deadline-ms", "5000", "--ask-delay-ms", "10")
    run = Call(system, *burst, "--queue-depth", "200").result()
    assert_flawless(run)
    sent = sorted(request["sent_s"] for request in run["requests"])
    answered = sorted(request["sent_s"] + request["latency_ms"] / 1e3 for request in run["requests"])
    in_flight = max(index + 1 - sum(when <= moment for when in answered) for index, moment in enumerate(sent))
    assert in_flight >= 100


def test_a_nat_that_rebinds_loses_nothing(system: System) -> None:
    call = Call(system, "--duration", "6", "--rate", "20")
    call.wait_until_sending()
    system.lab.nat("wlan0").rebind()
    system.lab.nat("wwan0").rebind()
    assert_flawless(call.result())


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
    argv = ["-m", "bench.echo", "serve", "--delay-ms", "700", "--delay-every", "1"]
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
