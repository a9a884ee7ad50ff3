"""UDP sockets of lab hosts in the test's own hands, and what the tests do with them."""

from __future__ import annotations

import contextlib
import re
import socket
import time
from functools import partial
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from lab import DirectionStats, Host, Link

# Far above any delay that the tests set; only a failing test waits so long.
PATIENCE_S = 10.0
# A datagram that should not come is given so long to come; a few times the delay of an idle lab.
SILENCE_S = 0.15
_RECEIVE_BUFFER_BYTES = 4 << 20


def udp(host: Host, *, device: str | None = None, port: int = 0, family: int = 4) -> socket.socket:
    """A UDP socket of `host`, bound to `device` if given and to `port` of the wildcard address."""
    made = host.socket(socket.AF_INET6 if family == 6 else socket.AF_INET, device=device)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
    made.bind(("::" if family == 6 else "0.0.0.0", port))
    made.settimeout(PATIENCE_S)
    return made


def silent(receiver: socket.socket, seconds: float = SILENCE_S) -> bool:
    """Whether nothing arrives for a while."""
    receiver.settimeout(seconds)
    try:
        receiver.recv(9000)
    except TimeoutError:
        return True
    finally:
        receiver.settimeout(PATIENCE_S)
    return False


def drain(receiver: socket.socket, into: list[bytes]) -> None:
    """Take all that waits."""
    receiver.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        while True:
            into.append(receiver.recv(9000))
    receiver.settimeout(PATIENCE_S)


def send_all(
    link: Link, sender: socket.socket, target: tuple[str, int], receiver: socket.socket, payloads: list[bytes]
) -> list[bytes]:
    """Send every payload up `link`, no faster than its emulator reads; return what came out."""
    before = link.stats().up
    received: list[bytes] = []
    for number, payload in enumerate(payloads, start=1):
        sender.sendto(payload, target)
        if number % 500 == 0 or number == len(payloads):
            await_stats(link, partial(_has_taken, before.sent_packets + number))
            drain(receiver, received)
    up = await_stats(link, lambda up: up.queue_bytes == 0 and up.in_flight_packets == 0)
    while len(received) < up.delivered_packets - before.delivered_packets:
        received.append(receiver.recv(9000))
    return received


def _has_taken(packets: int, up: DirectionStats) -> bool:
    return up.sent_packets >= packets


def await_stats(link: Link, enough: Callable[[DirectionStats], bool]) -> DirectionStats:
    """The first statistics of `link`, host to internet, that are `enough`."""
    deadline = time.monotonic() + PATIENCE_S
    while not enough(up := link.stats().up):
        assert time.monotonic() < deadline, up
        time.sleep(0.002)
    return up


def ping_times_ms(host: Host, target: str, *, device: str, family: int = 4, count: int = 5) -> list[float]:
    """Round-trip times that `ping` prints, of the answers that came."""
    done = host.run(
        ["ping", f"-{family}", "-n", "-I", device, "-c", str(count), "-i", "0.02", "-W", "2", target],
        timeout=PATIENCE_S,
    )
    return [float(found) for found in re.findall(r"time=([\d.]+) ms", done.stdout)]


def unreachable(host: Host, target: str, *, device: str) -> bool:
    """Whether a `ping` stays without answer, or cannot even be sent."""
    command = ["ping", "-n", "-I", device, "-c", "1", "-W", str(SILENCE_S), target]
    return host.run(command, timeout=PATIENCE_S).returncode != 0
