"""Run by test_sockets.py inside a network namespace of its own: prints what the sidecar's sockets did, as JSON.

robot namespace                         peer namespace (far end and echo server)
  wlan0 10.0.1.1, fd00:1::1  ───────────  10.0.1.2, fd00:1::2
  wwan0 10.0.2.1, fd00:2::1  ───────────  10.0.2.2, fd00:2::2
                                          lo: 10.9.9.9, fd00:9::9
Both links have a default route; wlan0's comes first.
"""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import json
import logging
import os
import platform
import select
import socket
import struct
import subprocess
import sys
import time
from typing import TYPE_CHECKING, Any

from plr.protos.model.ids import InterfaceName
from plr.sidecar.core.link.sender import Batch
from plr.sidecar.core.seam.stats import LinkStats
from plr.sidecar.net.batch_socket import BatchSocket
from plr.sidecar.net.interfaces import Interface, choose, list_interfaces
from plr.sidecar.net.sockets import DataSocket, normalise, open_socket, to_sockaddr

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.protos.model.ids import Address

LINKS = {"wlan0": 1, "wwan0": 2}
ECHO: dict[int, Address] = {4: ("10.9.9.9", 5000), 6: ("fd00:9::9", 5000)}
READY = "ready"
WAIT_S = 10.0


def say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def sh(command: str) -> None:
    subprocess.run(command.split(), check=True, capture_output=True)


@contextlib.contextmanager
def network() -> Iterator[None]:
    """Both namespaces of the drawing, as long as the block lasts."""
    argv = ["unshare", "--net", "--fork", "--kill-child", sys.executable, __file__, "echo"]
    with subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as peer:
        assert peer.stdin
        assert peer.stdout
        peer_pid = int(peer.stdout.readline())
        try:
            sh("ip link set lo up")
            for name, number in LINKS.items():
                sh(f"ip link add {name} type veth peer name far{number}")
                sh(f"ip link set far{number} netns {peer_pid}")
                sh(f"ip link set {name} up")
                sh(f"ip addr add 10.0.{number}.1/24 dev {name}")
                sh(f"ip addr add fd00:{number}::1/64 dev {name} nodad")
            peer.stdin.write("\n")
            peer.stdin.flush()
            assert peer.stdout.readline().strip() == READY
            for name, number in LINKS.items():
                sh(f"ip route add default via 10.0.{number}.2 dev {name} metric {number}00")
                sh(f"ip -6 route add default via fd00:{number}::2 dev {name} metric {number}00")
                with contextlib.suppress(OSError), open(f"/proc/sys/net/ipv4/conf/{name}/rp_filter", "w") as file:
                    file.write("0")
            yield
        finally:
            peer.stdin.close()


def echo_server() -> None:
    """Answer each datagram with the address it came from, until stdin is closed."""
    say(str(os.getpid()))
    sys.stdin.readline()
    for number in LINKS.values():
        sh(f"ip link set far{number} up")
        sh(f"ip addr add 10.0.{number}.2/24 dev far{number}")
        sh(f"ip addr add fd00:{number}::2/64 dev far{number} nodad")
    sh("ip link set lo up")
    sh("ip addr add 10.9.9.9/32 dev lo")
    sh("ip addr add fd00:9::9/128 dev lo nodad")
    servers = []
    for family, address in ((socket.AF_INET, ECHO[4]), (socket.AF_INET6, ECHO[6])):
        server = socket.socket(family, socket.SOCK_DGRAM)
        server.bind(address)
        servers.append(server)
    say(READY)
    while True:
        readable, _, _ = select.select([*servers, sys.stdin], [], [])
        if sys.stdin in readable:
            return
        for server in servers:
            if server in readable:
                _, sender = server.recvfrom(2048)
                server.sendto(json.dumps(normalise(sender)).encode(), sender)


def interface(name: str) -> Interface:
    (found,) = choose(list_interfaces(), [name]).usable
    return found


def source_seen_by_echo(sock: socket.socket, version: int) -> Address | None:
    """Send until the echo server answers (neighbour discovery may eat the first), return whom it saw."""
    target = to_sockaddr(sock.family, ECHO[version])
    if target is None:
        return None
    end = time.monotonic() + WAIT_S
    while time.monotonic() < end:
        sock.sendto(b"hello", target)
        if select.select([sock], [], [], 0.3)[0]:
            data, sender = sock.recvfrom(2048)
            assert normalise(sender) == ECHO[version]
            host, port = json.loads(data)
            return host, port
    raise TimeoutError(f"no echo over IPv{version}")


def describe(opened: DataSocket) -> dict[str, Any]:
    sock = opened.socket
    return {
        "bound_to": opened.bound_to,
        "family": sock.family.name,
        "port": sock.getsockname()[1],
        "blocking": sock.getblocking(),
        "receive_buffer": sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF),
        "send_buffer": sock.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF),
        "source4": (source_seen_by_echo(sock, 4) or [None])[0],
        "source6": (source_seen_by_echo(sock, 6) or [None])[0],
    }


def sockets_on_both_links(port: int = 0) -> dict[str, Any]:
    opened = {name: open_socket(interface(name), port) for name in LINKS}
    try:
        return {name: describe(entry) for name, entry in opened.items()}
    finally:
        for entry in opened.values():
            entry.socket.close()


def same_port() -> dict[str, Any]:
    return sockets_on_both_links(47001)


def no_capability() -> dict[str, Any]:
    forbid(SETSOCKOPT, (socket.SOL_SOCKET, socket.SO_BINDTODEVICE), error=1)
    return sockets_on_both_links()


def no_ipv6() -> dict[str, Any]:
    forbid(SOCKET, (socket.AF_INET6,), error=97)
    return sockets_on_both_links()


def taken_port() -> dict[str, Any]:
    wlan = interface("wlan0")
    with open_socket(wlan, 47001).socket:
        try:
            open_socket(wlan, 47001)
        except OSError as error:
            return {"error": error.errno}
    return {}


def too_long() -> dict[str, Any]:
    """A datagram over the MTU is refused, not cut into IP fragments."""
    answers = {}
    with open_socket(interface("wlan0"), 0).socket as sock:
        for version in (4, 6):
            try:
                sock.sendto(bytes(1600), to_sockaddr(sock.family, ECHO[version]) or ())
                answers[str(version)] = 0
            except OSError as error:
                answers[str(version)] = error.errno or 0
    return answers


def runs() -> dict[str, Any]:
    """Runs that fit the device, then runs of which only the last, shorter datagram does; over a device with and without
    checksum offload, which segmentation by the kernel used to need.
    """
    answers: dict[str, Any] = {}
    for offload in ("on", "off"):
        sh(f"ethtool -K wlan0 tx {offload}")
        for version, longest in ((4, 1472), (6, 1452)):
            with open_socket(interface("wlan0"), 0).socket as sock:
                source_seen_by_echo(sock, version)
                stats = LinkStats(InterfaceName("wlan0"))
                told: list[int] = []

                def note(_: object, size: int, told: list[int] = told) -> None:
                    told.append(size)

                batches = BatchSocket(sock, stats, note)
                for segment in (longest, longest + 1):
                    batches.send(Batch(ECHO[version], bytes(9 * segment + 40), segment))
                answered = 0
                while select.select([sock], [], [], 0.3)[0]:
                    for run in batches.receive():
                        answered += -(-len(run.data) // run.segment)
                answers[f"{version} {offload}"] = {
                    "answered": answered,
                    "dropped": dict(stats.dropped),
                    "segments": stats.offload["send"],
                    "told": [size - longest for size in told],
                }
    return answers


def interfaces() -> dict[str, Any]:
    sh("ip link add br-lab type bridge")
    sh("ip link add eth6 type veth peer name eth7")
    sh("ip link set eth6 up")
    sh("ip addr add 10.0.6.1/24 dev eth6")
    sh("ip addr add 169.254.6.1/16 dev eth6")
    sh("ip addr add 10.0.8.1 peer 10.0.8.2 dev wlan0")
    return {entry.name: dataclasses.asdict(entry) for entry in list_interfaces()}


# ── a kernel that refuses: the same EPERM as Linux before 5.7 without CAP_NET_RAW, made by seccomp ──

SETSOCKOPT = {"x86_64": 54, "aarch64": 208}
SOCKET = {"x86_64": 41, "aarch64": 198}
_LOAD, _JUMP_IF_EQUAL, _RETURN = 0x20, 0x15, 0x06
_ALLOW, _ERRNO = 0x7FFF0000, 0x00050000
_PR_SET_NO_NEW_PRIVS, _PR_SET_SECCOMP, _SECCOMP_MODE_FILTER = 38, 22, 2


def forbid(numbers: dict[str, int], arguments: tuple[int, ...], error: int) -> None:
    """Make one system call with these last checked arguments fail with `error` in this process, permanently."""
    checks = [(0, numbers[platform.machine()])]
    first = 1 if len(arguments) == 2 else 0
    checks += [(16 + 8 * (first + index), value) for index, value in enumerate(arguments)]
    program = b""
    for position, (offset, value) in enumerate(checks):
        to_allow = 2 * (len(checks) - position) - 1
        program += struct.pack("HBBI", _LOAD, 0, 0, offset)
        program += struct.pack("HBBI", _JUMP_IF_EQUAL, 0, to_allow, value)
    program += struct.pack("HBBI", _RETURN, 0, 0, _ERRNO | error)
    program += struct.pack("HBBI", _RETURN, 0, 0, _ALLOW)
    instructions = ctypes.create_string_buffer(program, len(program))
    descriptor = struct.pack("HxxxxxxP", len(program) // 8, ctypes.addressof(instructions))
    libc = ctypes.CDLL(None, use_errno=True)
    assert libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0
    assert libc.prctl(_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, descriptor, 0, 0) == 0, ctypes.get_errno()


SCENARIOS = {
    "sockets": sockets_on_both_links,
    "same_port": same_port,
    "no_capability": no_capability,
    "no_ipv6": no_ipv6,
    "taken_port": taken_port,
    "too_long": too_long,
    "runs": runs,
    "interfaces": interfaces,
}


if __name__ == "__main__":
    if sys.argv[1] == "echo":
        echo_server()
    else:
        logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s", stream=sys.stderr)
        with network():
            say(json.dumps(SCENARIOS[sys.argv[1]]()))
