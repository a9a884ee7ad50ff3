"""Interfaces come, go and move under a running robot: it follows within seconds, and no request is lost.

The tests share one running system; each leaves its interfaces as it found them.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

import pytest

from lab import Lab, LabConfig, LinkProfile
from lab.system import System
from tests.netns.cables import plug_in, pull_out
from tests.support.calling import Call, assert_flawless, counter

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = [pytest.mark.netns, pytest.mark.ros, pytest.mark.timeout(180)]

INTERFACES = ("wlan0", "wwan0", "usb0")
SERVICE = {"name": "/echo", "deadline_ms": 500, "lifetime_ms": 30_000, "idempotent": True}
SOON_S = 10.0
"""It takes well under a second on an idle machine; a scan without announcements would come as late as this."""


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    with Lab(LabConfig.of(interfaces=("wlan0", "wwan0"), clouds=1), seed=1) as lab:
        running = System(lab, tmp_path_factory.mktemp("roaming"))
        for name, delay_ms in (("wlan0", 5), ("wwan0", 15)):
            lab.link(name).set(LinkProfile(delay_ms=delay_ms))
        plug_in(lab, "robot", "usb0")
        running.start_control_plane()
        running.start_node("cloud_a.echo", "cloud_a", ["-m", "lab.echo", "serve"])
        running.start_cloud("cloud_a", [{"name": "/echo"}])
        running.wait_for_offer(running.start_robot([SERVICE], interfaces=INTERFACES))
        yield running
        running.close()


@pytest.fixture(autouse=True)
def all_up(system: System) -> None:
    """Every test starts with all paths up."""
    for interface in INTERFACES:
        wait_for_path(system, interface, up=True)


def wait_for_path(system: System, interface: str, *, up: bool) -> None:
    what = f"{interface} to be {'up' if up else 'down'}"
    system.wait(what, lambda: counter(system, "plr_path_up", interface=interface) == float(up), SOON_S)


def wait_for_log(system: System, *texts: str) -> None:
    """Wait until one of them stands there."""
    log = system.parts["robot.sidecar"].log
    system.wait(f"'{texts[0]}' in the log", lambda: any(text in log.read_text() for text in texts), SOON_S)


def peers_version(system: System) -> float:
    """Of the cloud's view of the robot."""
    return system.metrics("cloud_a").get("plr_peers_version", 0.0)


@contextlib.contextmanager
def flawless_call(system: System) -> Iterator[None]:
    """20 requests a second around what happens in the block."""
    call = Call(system, "--duration", "6", "--rate", "20", "--size", "2000")
    call.wait_until_sending()
    yield
    assert_flawless(call.result())


def test_an_interface_that_is_pulled_out_and_plugged_in_again(system: System) -> None:
    with flawless_call(system):
        pull_out(system.lab, "robot", "usb0")
        wait_for_log(system, "usb0: removed, or another device now")
        plug_in(system.lab, "robot", "usb0")
        wait_for_path(system, "usb0", up=True)
    received = counter(system, "plr_datagrams_total", interface="usb0", direction="received", kind="data")
    assert_flawless(Call(system, "--duration", "2", "--rate", "20").result())
    assert counter(system, "plr_datagrams_total", interface="usb0", direction="received", kind="data") >= received


def test_a_carrier_that_goes_and_comes_back(system: System) -> None:
    with flawless_call(system):
        system.lab.link("wlan0").unplug()
        wait_for_log(system, "wlan0: no carrier; its requests take other paths")
        wait_for_path(system, "wlan0", up=False)
        system.lab.link("wlan0").restore()
        wait_for_path(system, "wlan0", up=True)
    wait_for_log(system, "wlan0: back, addresses")


def test_an_interface_switched_off_and_on(system: System) -> None:
    robot = system.lab.host("robot")
    with flawless_call(system):
        robot.link_down("wwan0")
        wait_for_path(system, "wwan0", up=False)
        robot.link_up("wwan0")
        wait_for_path(system, "wwan0", up=True)


def test_an_address_that_changes_on_the_only_path(system: System) -> None:
    """Nothing takes over: what is under way when the old address goes must travel again from the new one."""
    robot = system.lab.host("robot")
    with flawless_call(system):
        for other in ("wwan0", "usb0"):
            robot.ip_batch([f"link set {other} down"])
        robot.ip_batch(
            [
                "addr flush dev wlan0 scope global",
                "addr add 192.168.1.77/24 dev wlan0",
                "route add default via 192.168.1.1 dev wlan0 metric 100",
            ]
        )
        # By whether the sidecar looked between the two.
        wait_for_log(system, "wlan0: addresses changed to 192.168.1.77", "wlan0: back, addresses 192.168.1.77")
        wait_for_path(system, "wlan0", up=True)
    robot.ip_batch(["addr flush dev wlan0 scope global"])
    robot.link_up("wlan0")
    robot.link_up("wwan0")
    pull_out(system.lab, "robot", "usb0")
    plug_in(system.lab, "robot", "usb0")


def test_a_gateway_that_changes(system: System) -> None:
    robot, router = system.lab.host("robot"), system.lab.nat("wlan0").router
    router.ip_batch(["addr add 192.168.1.9/24 dev lan0"])
    with flawless_call(system):
        robot.ip_batch(["route replace default via 192.168.1.9 dev wlan0 metric 100"])
        wait_for_log(system, "wlan0: gateways changed to 192.168.1.9")
        wait_for_path(system, "wlan0", up=True)
    robot.ip_batch(["route replace default via 192.168.1.1 dev wlan0 metric 100"])
    router.ip_batch(["addr del 192.168.1.9/24 dev lan0"])


def test_an_interface_that_is_renamed_and_gets_its_name_back(system: System) -> None:
    robot = system.lab.host("robot")
    with flawless_call(system):
        robot.ip_batch(["link set usb0 down", "link set usb0 name lte0", "link set lte0 up"])
        wait_for_log(system, "lte0: not used: not in the configuration")
        robot.ip_batch(["link set lte0 down", "link set lte0 name usb0", "link set usb0 up"])
        robot.ip_batch(["route add default via 10.77.0.1 dev usb0 metric 900"])
        wait_for_path(system, "usb0", up=True)
    pull_out(system.lab, "robot", "usb0")
    plug_in(system.lab, "robot", "usb0")


def test_an_interface_that_comes_back_while_the_control_plane_is_dead(system: System) -> None:
    """The cloud was told that it is gone; only the robot's own word can bring it back."""
    before = peers_version(system)
    system.lab.link("wlan0").unplug()
    wait_for_path(system, "wlan0", up=False)
    system.wait("the cloud to hear of it", lambda: peers_version(system) > before, SOON_S)
    system.parts["controlplane"].kill()
    system.lab.link("wlan0").restore()
    wait_for_path(system, "wlan0", up=True)
    with flawless_call(system):
        system.lab.link("wwan0").blackhole()
        system.lab.host("robot").ip_batch(["link set usb0 down"])
    system.lab.link("wwan0").restore()
    pull_out(system.lab, "robot", "usb0")
    plug_in(system.lab, "robot", "usb0")
    system.start_control_plane()
    registered = "registered with the control plane"
    log = system.parts["robot.sidecar"].log
    system.wait("the robot to register again", lambda: log.read_text().count(registered) > 1)


@pytest.mark.audit("ops-1")
def test_a_modem_that_is_missing_when_the_robot_starts(system: System) -> None:
    """The others carry; it is used when it comes."""
    assert system.parts["robot.sidecar"].terminate() == 0
    pull_out(system.lab, "robot", "usb0")
    system.parts["robot.sidecar"].log.unlink()
    system.wait_for_offer(system.start_robot([SERVICE], interfaces=INTERFACES))
    wait_for_log(system, "usb0: there is no such interface now (there are: ")
    assert counter(system, "plr_interface_in_use", interface="usb0") == 0
    with flawless_call(system):
        plug_in(system.lab, "robot", "usb0")
        wait_for_path(system, "usb0", up=True)
    assert counter(system, "plr_interface_in_use", interface="usb0") == 1


def test_one_path_of_ipv6_only_and_one_of_ipv4_only(system: System) -> None:
    """STUN servers here speak IPv4 only; the IPv6 path is used without."""
    robot = system.lab.host("robot")
    assert system.parts["robot.sidecar"].terminate() == 0
    robot.run(["ip", "-4", "addr", "flush", "dev", "wlan0"], check=True)
    robot.run(["ip", "-6", "addr", "flush", "dev", "wwan0"], check=True)
    robot.ip_batch(["link set usb0 down"])
    system.parts["robot.sidecar"].log.unlink()
    system.wait_for_offer(system.start_robot([SERVICE], interfaces=INTERFACES))
    for interface in ("wlan0", "wwan0"):
        wait_for_path(system, interface, up=True)
    with flawless_call(system):
        system.lab.link("wwan0").blackhole()
    system.lab.link("wwan0").restore()
    wait_for_path(system, "wwan0", up=True)
    with flawless_call(system):
        system.lab.link("wlan0").blackhole()
    system.lab.link("wlan0").restore()
