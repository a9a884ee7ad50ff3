"""Serves STUN: a thread of its own moves datagrams between UDP sockets and the responder.

A starting robot asks before it registers, and needs the answer within its retransmissions. In the event loop it would
wait behind the registrations of a whole fleet, and a flood from anybody would hold up everybody's streams. The two
threads still share the interpreter. It serves this thread half a millisecond after it asks, and the thread takes a
quarter of a processor at most: it rests three times as long as it has worked.

The sockets are plain and non-blocking for two reasons. A wake-up drains a batch of requests, and a host with several
addresses answers from the address that was asked (IP_PKTINFO); NATs and clients refuse any other answer.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import selectors
import socket
import struct
import sys
import threading
import time
from collections import Counter
from ipaddress import IPv6Address
from typing import TYPE_CHECKING, Any

from plr.controlplane.core.stun.responder import StunOutcome, StunResponder
from plr.protos.stun.codec import MAX_STUN_BYTES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from plr.protos.model.ids import Address

log = logging.getLogger(__name__)

BATCH_DATAGRAMS = 64
"""Datagrams taken per wake-up and socket: 1 to 2 ms of work, then a rest no longer than others can wait."""

SHARE = 0.25
"""Maximum share of one processor: some thousand answers a second, ten times what the largest fleet asks at start."""

RECEIVE_BUFFER_BYTES = 1 << 20
"""Requested kernel buffer: a fleet that returns from an outage asks all at once."""

SAME_PORT_ATTEMPTS = 16
"""Attempts to find one free port for all addresses when port 0 is requested."""

STOP_TIMEOUT_S = 1.0
"""A thread that has not ended by then is left until the program ends."""

# From linux/in.h and asm-generic/socket.h: not every Python supported here names them in the socket module.
_IP_PKTINFO = 8
_SO_RXQ_OVFL = 40

_PKTINFO4 = struct.Struct("=I4s4s")
_PKTINFO6 = struct.Struct("=16sI")
_DROPS_BYTES = 4
_ANCILLARY_BYTES = socket.CMSG_SPACE(_PKTINFO6.size) + socket.CMSG_SPACE(_DROPS_BYTES)


class StunServer:
    """A running server; its counters may be read on any thread.

    `send_failures` counts answers that the kernel refused.
    """

    def __init__(self, sockets: Sequence[socket.socket], software: str | None) -> None:
        self.send_failures = 0
        self.receive_failures = 0
        self._responder = StunResponder(time.monotonic(), software=software)
        self._sockets = list(sockets)
        self._drops = dict.fromkeys(self._sockets, 0)
        """Drops of each socket, as the kernel last reported them."""
        self.addresses: tuple[Address, ...] = tuple(sock.getsockname()[:2] for sock in self._sockets)
        self._failed = False
        self._stopping = False
        self._waker, self._woken = socket.socketpair()
        self._thread = threading.Thread(target=self._serve, name="plr-stun", daemon=True)
        self._thread.start()

    @property
    def outcomes(self) -> Counter[StunOutcome]:
        """Datagrams so far, by outcome."""
        return Counter(self._responder.outcomes.copy())

    @property
    def buffer_full(self) -> int:
        """Datagrams that the kernel dropped because too many came; counted when a later one is read."""
        return sum(self._drops.values())

    def close(self) -> None:
        """Stop answering and free the ports; may be called twice."""
        if self._stopping:
            return
        self._stopping = True
        self._waker.close()
        self._thread.join(STOP_TIMEOUT_S)
        for sock in (*self._sockets, self._woken):
            sock.close()

    # ── its thread ──

    def _serve(self) -> None:
        with selectors.DefaultSelector() as selector:
            for sock in (*self._sockets, self._woken):
                selector.register(sock, selectors.EVENT_READ, sock)
            while not self._stopping:
                ready = [key.data for key, _ in selector.select()]
                began = time.thread_time()
                for sock in ready:
                    if sock is not self._woken:
                        self._drain(sock)
                time.sleep((time.thread_time() - began) * (1.0 / SHARE - 1.0))

    def _drain(self, sock: socket.socket) -> None:
        now = time.monotonic()
        for _ in range(BATCH_DATAGRAMS):
            try:
                # One byte more than a message may have: a truncated one must not look complete.
                data, ancillary, _, peer = sock.recvmsg(MAX_STUN_BYTES + 1, _ANCILLARY_BYTES)
            except BlockingIOError:
                return
            except OSError:
                self.receive_failures += 1
                return
            try:
                self._note_drops(sock, ancillary)
                response = self._responder.respond(data, _address(peer), now)
            except Exception:
                # A bug of ours. It must not end the thread or write a log line for each datagram.
                self.receive_failures += 1
                if not self._failed:
                    log.exception("STUN: a datagram of %s could not be answered; further ones are only counted", peer)
                self._failed = True
                continue
            if response is None:
                continue
            try:
                sock.sendmsg([response], _reply_from(ancillary), 0, peer)
            except OSError:
                self.send_failures += 1

    def _note_drops(self, sock: socket.socket, ancillary: list[tuple[int, int, bytes]]) -> None:
        for level, kind, value in ancillary:
            if (level, kind) == (socket.SOL_SOCKET, _SO_RXQ_OVFL):
                before = self._drops[sock]
                # 32 bits, which wrap.
                self._drops[sock] += (int.from_bytes(value, sys.byteorder) - before) % (1 << 32)


async def start_stun_server(hosts: str | Sequence[str], port: int, *, software: str | None = None) -> StunServer:
    """Answer on every address of `hosts`, all on one port (0: a free one, see `addresses`).

    "" stands for all addresses of both families; only then may IPv6 be missing on the machine. Raises OSError
    when an address is not available.
    """
    names = [hosts] if isinstance(hosts, str) else list(hosts)
    loop = asyncio.get_running_loop()
    wanted: dict[tuple[socket.AddressFamily, Any], bool] = {}
    for name in names:
        if name == "":
            wanted[(socket.AF_INET, ("0.0.0.0", port))] = True  # noqa: S104 - what was asked for
            wanted.setdefault((socket.AF_INET6, ("::", port, 0, 0)), False)
            continue
        for family, _, _, _, sockaddr in await loop.getaddrinfo(name, port, type=socket.SOCK_DGRAM):
            wanted[(family, sockaddr)] = True
    if not wanted:
        raise OSError(errno.EADDRNOTAVAIL, "no address to listen on")
    return StunServer(_bind_all(wanted, port), software)


def _bind_all(wanted: dict[tuple[socket.AddressFamily, Any], bool], port: int) -> list[socket.socket]:
    for attempt in range(SAME_PORT_ATTEMPTS):
        sockets: list[socket.socket] = []
        try:
            for (family, sockaddr), required in wanted.items():
                chosen = sockets[0].getsockname()[1] if port == 0 and sockets else port
                try:
                    sockets.append(_bind(family, (sockaddr[0], chosen, *sockaddr[2:])))
                except OSError as error:
                    if required or error.errno not in (errno.EAFNOSUPPORT, errno.EADDRNOTAVAIL):
                        raise
                    log.warning("STUN: this machine has no IPv6, so answers go over IPv4 only")
        except OSError as error:
            for sock in sockets:
                sock.close()
            if port == 0 and error.errno == errno.EADDRINUSE and attempt < SAME_PORT_ATTEMPTS - 1:
                continue
            raise
        return sockets
    raise OSError(errno.EADDRINUSE, "no port that is free on all addresses")


def _bind(family: socket.AddressFamily, sockaddr: Any) -> socket.socket:
    sock = socket.socket(family, socket.SOCK_DGRAM)
    try:
        sock.setblocking(False)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        sock.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
        if family == socket.AF_INET6:
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_RECVPKTINFO, 1)
        else:
            sock.setsockopt(socket.IPPROTO_IP, _IP_PKTINFO, 1)
        sock.bind(sockaddr)
    except BaseException:
        sock.close()
        raise
    return sock


def _address(peer: Any) -> Address:
    host, _, _ = peer[0].partition("%")
    return host, peer[1]


def _reply_from(ancillary: list[tuple[int, int, bytes]]) -> list[tuple[int, int, bytes]]:
    """Return ancillary data that makes the kernel send from the address that the request was sent to."""
    for level, kind, value in ancillary:
        if (level, kind) == (socket.IPPROTO_IP, _IP_PKTINFO) and len(value) >= _PKTINFO4.size:
            _, destination, _ = _PKTINFO4.unpack_from(value)
            # No interface is given (0): the routing table chooses the way back.
            return [(level, kind, _PKTINFO4.pack(0, destination, bytes(4)))]
        if (level, kind) == (socket.IPPROTO_IPV6, socket.IPV6_PKTINFO) and len(value) >= _PKTINFO6.size:
            destination, index = _PKTINFO6.unpack_from(value)
            link_local = IPv6Address(destination).is_link_local
            return [(level, kind, _PKTINFO6.pack(destination, index if link_local else 0))]
    return []
