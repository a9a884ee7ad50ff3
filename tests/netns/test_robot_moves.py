"""A robot and a cloud without IPv4, interfaces that are renamed while in use, a robot that stands still.

The tests share one running system; each leaves it as it found it.
"""

from __future__ import annotations

import signal
import time
from typing import TYPE_CHECKING, Any

import pytest

from lab import Lab, LabConfig, LinkProfile
from lab.system import CONTROL_PORT, STUN_PORT, System
from tests.support.calling import Call, assert_flawless, counter

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = [pytest.mark.netns, pytest.mark.ros, pytest.mark.timeout(180), pytest.mark.audit("dp-16")]

INTERFACES = ("wlan0", "wwan0")
HOSTS = ("robot", "cloud_a", "control")
SERVICE = {"name": "/echo", "deadline_ms": 500, "lifetime_ms": 30_000, "idempotent": True}
STANDS_STILL_S = 8.0
SOON_S = 20.0


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    """No host has an IPv4 address but that of its loopback."""
    with Lab(LabConfig.of(interfaces=INTERFACES, clouds=1), seed=1) as lab:
        for name, delay_ms in (("wlan0", 5), ("wwan0", 15)):
            lab.link(name).set(LinkProfile(delay_ms=delay_ms))
        control = f"[{lab.host('control').address(family=6)}]"
        for name in HOSTS:
            lab.host(name).run(["ip", "-4", "addr", "flush", "scope", "global"], check=True)
        running = System(lab, tmp_path_factory.mktemp("moves"))
        running.start_control_plane(
            listen=f"[::]:{CONTROL_PORT}", stun_listen=[f"[::]:{STUN_PORT}"], stun_servers=[f"{control}:{STUN_PORT}"]
        )
        over_ipv6: dict[str, Any] = {"control_plane": f"{control}:{CONTROL_PORT}"}
        running.start_node("cloud_a.echo", "cloud_a", ["-m", "lab.echo", "serve"])
        running.start_cloud("cloud_a", [{"name": "/echo"}], **over_ipv6)
        running.wait_for_offer(running.start_robot([SERVICE], interfaces=INTERFACES, **over_ipv6))
        yield running
        running.close()


@pytest.fixture(autouse=True)
def all_up(system: System) -> None:
    """Every test starts with all paths up."""
    for interface in INTERFACES:
        wait_for_path(system, interface)


def wait_for_path(system: System, interface: str) -> None:
    system.wait(f"{interface} to be up", lambda: counter(system, "plr_path_up", interface=interface) == 1.0, SOON_S)


def begin_call(system: System, seconds: int) -> Call:
    # The client makes up for what it did not send while it stood still: more answers at once than rmw keeps for it.
    queue = ("--queue-depth", "400")
    call = Call(system, "--duration", str(seconds), "--rate", "20", "--size", "20000", *queue)
    call.wait_until_sending()
    return call


def test_nothing_needs_ipv4(system: System) -> None:
    call = begin_call(system, 5)
    system.lab.link("wlan0").blackhole()
    time.sleep(1.0)
    system.lab.link("wlan0").restore()
    wait_for_path(system, "wlan0")
    system.lab.nat("wwan0").rebind()
    assert_flawless(call.result())
    log = system.parts["robot.sidecar"].log.read_text()
    assert "wlan0: reachable from outside as fd00:" in log


def test_interfaces_swap_their_names_while_in_use(system: System) -> None:
    """Kernels from 6.2 on rename an interface that is up; older ones want it down."""
    robot = system.lab.host("robot")
    live = robot.run(["ip", "link", "set", "wlan0", "name", "wlan9"]).returncode == 0
    if live:
        robot.ip_batch(["link set wlan9 name wlan0"])
    else:
        pytest.skip("this kernel does not rename an interface that is up")
    wait_for_path(system, "wlan0")
    call = begin_call(system, 8)
    robot.ip_batch(["link set wlan0 name wlan9"])
    time.sleep(1.5)
    robot.ip_batch(["link set wwan0 name wlan0", "link set wlan9 name wwan0"])
    for interface in INTERFACES:
        wait_for_path(system, interface)
    robot.ip_batch(["link set wlan0 name wlan9", "link set wwan0 name wlan0", "link set wlan9 name wwan0"])
    for interface in INTERFACES:
        wait_for_path(system, interface)
    assert_flawless(call.result())


def test_a_robot_that_stands_still_and_goes_on(system: System) -> None:
    """All its processes are stopped for longer than its servers and the control plane wait for a sign of life."""
    call = begin_call(system, 4 + round(STANDS_STILL_S))
    still = [part for name, part in system.parts.items() if name.startswith(("robot", "client"))]
    for part in still:
        part.process.send_signal(signal.SIGSTOP)
    try:
        time.sleep(STANDS_STILL_S)
        for interface in INTERFACES:
            system.lab.nat(interface).rebind()
    finally:
        for part in still:
            part.process.send_signal(signal.SIGCONT)
    run = call.result()
    assert_flawless(run)
    late = [one for one in run["requests"] if one["latency_ms"] > 1e3 * STANDS_STILL_S / 2]
    assert len(late) <= 5  # what was under way when it stopped; nothing of what was asked since
