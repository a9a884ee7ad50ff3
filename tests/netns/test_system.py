"""Calls of unmodified ROS programs through the whole system, over links that lose, go dark and rebind."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import pytest

from tests.netns.two_clouds import CLOUDS, executed, make_links_good, offered, two_clouds
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
    """The servers take 25 ms each, one by one, so that the last of 150 is in flight for nearly 4 s.

    The client keeps more answers than rclpy's default of 10, which a client that is slow for a moment overflows.
    """
    burst = ("--duration", "0.1", "--rate", "1500", "--deadline-ms", "9000", "--ask-delay-ms", "25")
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
