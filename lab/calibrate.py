"""Measures how much traffic the emulator carries on this machine, and how much delay it adds."""

from __future__ import annotations

import contextlib
import socket
import sys
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lab.errors import LabError
from lab.profile import LinkProfile

if TYPE_CHECKING:
    from lab.host import Host, HostProcess
    from lab.lab import Lab

_UDP_SEGMENT = 103  # linux/udp.h
_PACKET_BYTES = 1200
_SEGMENTS = 40
_PORT = 6000
# Runs with -S on a cloud host; returns one datagram for each.
_ECHO = (
    "import socket,sys\n"
    "s=socket.socket(socket.AF_INET6,socket.SOCK_DGRAM)\n"
    "s.bind(('::',int(sys.argv[1])))\n"
    "while True:\n"
    "    data,peer=s.recvfrom(9000)\n"
    "    s.sendto(data,peer)\n"
)


@dataclass(frozen=True, slots=True)
class Calibration:
    """The results for one link of an otherwise idle lab with zero delay. Times are one-way, in microseconds."""

    port_kind: str
    packets_per_s: float
    cpu_share: float
    """Share of one core used at `packets_per_s`."""
    added_p50_us: float
    """Half the round trip over the emulated link and its NAT, minus half of that over plain cables."""
    added_p99_us: float
    realtime: bool


def start_echo(host: Host, port: int = _PORT) -> HostProcess:
    """Start a UDP echo server on a host, IPv4 and IPv6; it answers as soon as this returns."""
    server = host.popen([sys.executable, "-S", "-c", _ECHO, str(port)])
    probe = host.socket()
    with probe:
        probe.settimeout(0.05)
        for _ in range(200):
            with contextlib.suppress(TimeoutError, ConnectionRefusedError):
                probe.sendto(b"ready?", ("127.0.0.1", port))
                probe.recv(100)
                return server
            if server.poll() is not None:
                break
    raise LabError(f"{host.name}: the echo server did not start")


def calibrate(lab: Lab, interface: str, *, seconds: float = 2.0, round_trips: int = 2000) -> Calibration:
    """Measure one link, and reset it."""
    robot, cloud, other = lab.config.robots[0].name, lab.config.clouds[0].name, lab.config.control.name
    link = lab.link(interface, host=robot)
    link.set(LinkProfile())
    link.restore()
    server = start_echo(lab.host(cloud))
    target = (lab.host(cloud).address(), _PORT)
    try:
        with lab.host(other).socket() as plain:
            direct = _round_trips(plain, target, round_trips)
        with lab.host(robot).socket(device=interface) as sender:
            emulated = _round_trips(sender, target, round_trips)
    finally:
        lab.host(cloud).kill(server)
    with lab.host(robot).socket(device=interface) as sender, lab.host(cloud).socket() as sink:
        sink.bind(("0.0.0.0", _PORT))
        sender.setsockopt(socket.IPPROTO_UDP, _UDP_SEGMENT, _PACKET_BYTES)
        sender.connect(target)
        burst = bytes(_PACKET_BYTES * _SEGMENTS)
        before, began = link.stats(), time.monotonic()
        while time.monotonic() - began < seconds:
            sender.send(burst)
        after, took = link.stats(), time.monotonic() - began
    link.reset()
    return Calibration(
        port_kind=lab.port_kind,
        packets_per_s=(after.up.delivered_packets - before.up.delivered_packets) / took,
        cpu_share=(after.cpu_s - before.cpu_s) / took,
        added_p50_us=(_quantile(emulated, 0.5) - _quantile(direct, 0.5)) / 2 * 1e6,
        added_p99_us=(_quantile(emulated, 0.99) - _quantile(direct, 0.99)) / 2 * 1e6,
        realtime=after.realtime,
    )


def _round_trips(sender: socket.socket, target: tuple[str, int], count: int) -> list[float]:
    sender.settimeout(5.0)
    times = []
    for _ in range(count):
        began = time.perf_counter()
        sender.sendto(b"x" * 200, target)
        sender.recv(300)
        times.append(time.perf_counter() - began)
    return sorted(times)


def _quantile(ordered: list[float], q: float) -> float:
    return ordered[min(len(ordered) - 1, int(q * len(ordered)))]
