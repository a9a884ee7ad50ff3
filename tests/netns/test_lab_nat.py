"""The NAT routers and what can be reached through them."""

from __future__ import annotations

import pytest

from lab import HostSpec, InterfaceSpec, Lab, LabConfig, NatSpec, server
from tests.netns.lab_traffic import ping_times_ms, silent, udp, unreachable

pytestmark = pytest.mark.netns
PORT = 5000
INTERFACES = ("wlan0", "wwan0")


@pytest.mark.parametrize("family", [4, 6])
@pytest.mark.parametrize("device", INTERFACES)
def test_every_interface_reaches_every_server_when_bound_to_the_device(lab: Lab, device: str, family: int) -> None:
    robot = lab.host("robot")
    for name in ("cloud_a", "cloud_b", "control"):
        server = lab.host(name)
        address = server.address("eth0", family)
        with (
            udp(robot, device=device, family=family) as sender,
            udp(server, port=PORT, family=family) as receiver,
        ):
            sender.sendto(b"request", (address, PORT))
            data, source = receiver.recvfrom(100)
            assert data == b"request"
            expected = lab.nat(device).public_address if family == 4 else robot.address(device, 6)
            assert source[0] == expected
            receiver.sendto(b"response", source)
            assert sender.recv(100) == b"response"


@pytest.mark.parametrize("family", [4, 6])
def test_unsolicited_datagrams_stay_outside(lab: Lab, family: int) -> None:
    robot, cloud = lab.host("robot"), lab.host("cloud_a")
    inside = robot.address("wwan0", 6) if family == 6 else lab.nat("wwan0").public_address
    with udp(robot, device="wwan0", family=family) as sender, udp(cloud, family=family) as stranger:
        port = sender.getsockname()[1]
        stranger.sendto(b"let me in", (inside, port))
        assert silent(sender)
        sender.sendto(b"hello", (cloud.address("eth0", family), stranger.getsockname()[1]))
        _, source = stranger.recvfrom(100)
        stranger.sendto(b"answer", source)
        assert sender.recv(100) == b"answer"


def test_hole_is_punched_with_the_address_a_third_party_sees(lab: Lab) -> None:
    robot, control, cloud = lab.host("robot"), lab.host("control"), lab.host("cloud_b")
    with (
        udp(robot, device="wwan0") as sender,
        udp(control, port=3478) as stun,
        udp(cloud, port=PORT) as peer,
    ):
        sender.sendto(b"who am I?", (control.address(), 3478))
        _, mapped = stun.recvfrom(100)
        peer.sendto(b"too early", mapped)
        assert silent(sender)
        sender.sendto(b"punch", (cloud.address(), PORT))
        assert peer.recvfrom(100) == (b"punch", mapped)
        peer.sendto(b"through", mapped)
        assert sender.recv(100) == b"through"


def test_rebinding_gives_the_flow_another_port(lab: Lab) -> None:
    robot, cloud = lab.host("robot"), lab.host("cloud_a")
    with udp(robot, device="wwan0") as sender, udp(cloud, port=PORT) as peer:
        sources = []
        for _ in range(3):
            sender.sendto(b"request", (cloud.address(), PORT))
            _, source = peer.recvfrom(100)
            sources.append(source)
            peer.sendto(b"response", source)
            assert sender.recv(100) == b"response"
            lab.nat("wwan0").rebind()
            peer.sendto(b"to the old port", source)
            assert silent(sender)
        assert len(set(sources)) == 3
        assert {address for address, _ in sources} == {lab.nat("wwan0").public_address}


def test_rebinding_one_router_leaves_the_other_alone(lab: Lab) -> None:
    robot, cloud = lab.host("robot"), lab.host("cloud_a")
    with udp(robot, device="wlan0") as sender, udp(cloud, port=PORT) as peer:
        sender.sendto(b"request", (cloud.address(), PORT))
        _, source = peer.recvfrom(100)
        lab.nat("wwan0").rebind()
        peer.sendto(b"response", source)
        assert sender.recv(100) == b"response"


def test_symmetric_router_maps_every_destination_separately() -> None:
    robot = HostSpec("robot", (InterfaceSpec("wwan0", emulated=False, nat=NatSpec("symmetric")),))
    with Lab(LabConfig(robots=(robot,))) as lab:
        clouds = [lab.host(name) for name in ("cloud_a", "cloud_b", "control")]
        with udp(lab.host("robot")) as sender:
            ports = set()
            for cloud in clouds:
                with udp(cloud, port=PORT) as peer:
                    sender.sendto(b"x", (cloud.address(), PORT))
                    ports.add(peer.recvfrom(100)[1][1])
        assert len(ports) == 3


def test_source_routing_serves_sockets_bound_to_an_address_only() -> None:
    for source_routing, device in ((False, "wlan0"), (True, "wwan0")):
        config = LabConfig(source_routing=source_routing)
        with Lab(config) as lab:
            robot, cloud = lab.host("robot"), lab.host("cloud_a")
            with robot.socket() as sender, udp(cloud, port=PORT) as peer:
                sender.bind((robot.address("wwan0"), 0))
                sender.sendto(b"x", (cloud.address(), PORT))
                assert peer.recvfrom(100)[1][0] == lab.nat(device).public_address


def test_interfaces_of_four_kinds_and_two_robots_work_together() -> None:
    config = LabConfig.of(interfaces=("wlan0", "wwan0", "usb0", "eth0"), clouds=1, robots=2)
    with Lab(config) as lab:
        target = lab.host("cloud_a").address()
        for robot in ("robot", "robot_2"):
            for interface in lab.host(robot).interfaces:
                assert len(ping_times_ms(lab.host(robot), target, device=interface, count=1)) == 1
        lab.link("usb0", host="robot_2").blackhole()
        assert unreachable(lab.host("robot_2"), target, device="usb0")
        assert len(ping_times_ms(lab.host("robot"), target, device="usb0", count=1)) == 1


def test_server_can_be_far_away_and_packets_small() -> None:
    robot = HostSpec("robot", (InterfaceSpec("eth0", emulated=False, mtu=1300),))
    config = LabConfig(robots=(robot,), clouds=(server("near"), server("far", delay_ms=20)))
    with Lab(config) as lab:
        for family in (4, 6):
            near, far = (
                ping_times_ms(lab.host("robot"), lab.host(name).address(family=family), device="eth0", family=family)
                for name in ("near", "far")
            )
            assert len(near) == len(far) == 5
            assert min(near) < 40 <= min(far)
        with udp(lab.host("robot")) as sender, udp(lab.host("near"), port=PORT) as receiver:
            sender.sendto(bytes(2000), (lab.host("near").address(), PORT))  # in fragments
            assert receiver.recv(9000) == bytes(2000)
        assert "mtu 1300 " in lab.host("robot").run(["ip", "link", "show", "eth0"]).stdout
        lab.link("eth0", host="far").blackhole()
        assert unreachable(lab.host("robot"), lab.host("far").address(), device="eth0")
