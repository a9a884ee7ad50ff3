"""Both ways in which the emulator gets its frames, TAP devices and packet sockets, behave alike."""

from __future__ import annotations

import socket
import threading
import time
from typing import TYPE_CHECKING, Literal

import pytest

from lab import DropReason, Lab, LabConfig, LinkProfile
from tests.netns.lab_traffic import PATIENCE_S, ping_times_ms, silent, udp, unreachable

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.netns
PORT = 5000
UDP_SEGMENT = 103  # linux/udp.h


@pytest.fixture(scope="module", params=["tap", "packet"])
def ported_lab(request: pytest.FixtureRequest) -> Iterator[Lab]:
    kind: Literal["tap", "packet"] = request.param
    with Lab(LabConfig(ports=kind)) as lab:
        assert lab.port_kind == kind
        yield lab


@pytest.fixture
def lab(ported_lab: Lab) -> Lab:
    ported_lab.link("wlan0").reset()
    return ported_lab


def test_segments_of_one_send_are_packets_of_their_own(lab: Lab) -> None:
    cloud, link = lab.host("cloud_a"), lab.link("wlan0")
    with udp(lab.host("robot"), device="wlan0") as sender, udp(cloud, port=PORT) as receiver:
        sender.setsockopt(socket.IPPROTO_UDP, UDP_SEGMENT, 1000)
        before = link.stats()
        sender.sendto(b"".join(bytes([number]) * 1000 for number in range(40)), (cloud.address(), PORT))
        assert [receiver.recv(2000) for _ in range(40)] == [bytes([number]) * 1000 for number in range(40)]
        after = link.stats()
    assert after.up.delivered_packets - before.up.delivered_packets == 40
    assert after.up.delivered_bytes - before.up.delivered_bytes == 40 * 1028  # with IPv4 and UDP headers


@pytest.mark.parametrize("direction", ["up", "down"])
@pytest.mark.parametrize("family", [4, 6])
def test_tcp_carries_a_megabyte_whole(lab: Lab, family: int, direction: str) -> None:
    lab.link("wlan0").set(LinkProfile(delay_ms=2, loss=0.005))
    kind = socket.AF_INET6 if family == 6 else socket.AF_INET
    robot, cloud = lab.host("robot"), lab.host("cloud_a")
    sent = bytes(range(256)) * 4096
    with (
        cloud.socket(kind, socket.SOCK_STREAM) as listener,
        robot.socket(kind, socket.SOCK_STREAM, device="wlan0") as client,
    ):
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(("::" if family == 6 else "0.0.0.0", PORT))
        listener.listen()
        listener.settimeout(PATIENCE_S)
        client.settimeout(PATIENCE_S)
        client.connect((cloud.address(family=family), PORT))
        served, _ = listener.accept()
        with served:
            served.settimeout(PATIENCE_S)
            source, sink = (client, served) if direction == "up" else (served, client)
            sending = threading.Thread(target=send_and_end, args=(source, sent))
            sending.start()
            received = bytearray()
            while data := sink.recv(1 << 16):
                received += data
            sending.join()
    assert received == sent


def send_and_end(source: socket.socket, data: bytes) -> None:
    source.sendall(data)
    source.shutdown(socket.SHUT_WR)


def test_carrier_goes_and_comes(lab: Lab) -> None:
    robot, cloud, link = lab.host("robot"), lab.host("cloud_a").address(), lab.link("wlan0")
    for _ in range(2):
        link.unplug()
        assert robot.run(["cat", "/sys/class/net/wlan0/carrier"]).stdout == "0\n"
        assert unreachable(robot, cloud, device="wlan0")
        link.restore()
        assert robot.run(["cat", "/sys/class/net/wlan0/carrier"]).stdout == "1\n"
        for family in (4, 6):
            address = lab.host("cloud_a").address(family=family)
            assert len(ping_times_ms(robot, address, device="wlan0", family=family, count=2)) == 2


def test_packets_for_an_interface_that_is_down_are_counted(lab: Lab) -> None:
    robot, cloud, link = lab.host("robot"), lab.host("cloud_a"), lab.link("wlan0")
    with udp(robot, device="wlan0") as inside, udp(cloud, port=PORT) as outside:
        inside.sendto(b"hello", (cloud.address(), PORT))
        _, source = outside.recvfrom(100)
        before = link.stats()
        robot.link_down("wlan0")
        # The kernel tells the far end of a veth pair a moment later; a TAP knows at once.
        deadline = time.monotonic() + PATIENCE_S
        while link.stats().down.drops[DropReason.INTERFACE_DOWN] == before.down.drops[DropReason.INTERFACE_DOWN]:
            assert time.monotonic() < deadline
            outside.sendto(b"lost", source)
            time.sleep(0.005)
        assert silent(inside)
        robot.link_up("wlan0")
        outside.sendto(b"there", source)
        assert inside.recv(100) == b"there"
