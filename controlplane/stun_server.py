"""UDP sockets of the STUN server: moves datagrams between them and the responder.

Plain non-blocking sockets on the loop's reader callbacks instead of a DatagramProtocol, for two reasons: a
wake-up drains a batch of requests, and a host with several addresses answers from the address that was asked
(IP_PKTINFO), without which NATs and clients refuse the answer.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
import struct
from ipaddress import IPv6Address
from typing import TYPE_CHECKING, Any

from controlplane.core.stun_responder import StunOutcome, StunResponder
from protos.stun import MAX_MESSAGE_BYTES

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Sequence

    from protos.model import Address

log = logging.getLogger(__name__)

BATCH_DATAGRAMS = 64
"""Datagrams taken per wake-up: about a millisecond of work, so that the gRPC streams of the loop go on."""

RECEIVE_BUFFER_BYTES = 1 << 20
"""Wanted kernel buffer: a fleet that returns from an outage asks all at once."""

SAME_PORT_ATTEMPTS = 16
"""Tries to find one free port for all addresses when port 0 is asked for."""

_IP_PKTINFO = 8
"""From linux/in.h: not every Python supported here names it in the socket module."""

_PKTINFO4 = struct.Struct("=I4s4s")
_PKTINFO6 = struct.Struct("=16sI")
_ANCILLARY_BYTES = socket.CMSG_SPACE(_PKTINFO6.size)


class StunServer:
    """A running server; `outcomes` counts what came in, `send_failures` answers that the kernel refused."""

    def __init__(self, sockets: Sequence[socket.socket], software: str | None) -> None:
        self.send_failures = 0
        self.receive_failures = 0
        self._loop = asyncio.get_running_loop()
        self._responder = StunResponder(self._loop.time(), software=software)
        self._sockets = list(sockets)
        self.addresses: tuple[Address, ...] = tuple(sock.getsockname()[:2] for sock in self._sockets)
        for sock in self._sockets:
            self._loop.add_reader(sock, self._drain, sock)

    @property
    def outcomes(self) -> Counter[StunOutcome]:
        """Datagrams by what came of them."""
        return self._responder.outcomes

    def close(self) -> None:
        """Stop answering and free the ports; may be called twice."""
        while self._sockets:
            sock = self._sockets.pop()
            self._loop.remove_reader(sock)
            sock.close()

    def _drain(self, sock: socket.socket) -> None:
        now = self._loop.time()
        for _ in range(BATCH_DATAGRAMS):
            try:
                # One byte more than a message may have: what is cut off must not look whole.
                data, ancillary, _, peer = sock.recvmsg(MAX_MESSAGE_BYTES + 1, _ANCILLARY_BYTES)
            except BlockingIOError:
                return
            except OSError:
                self.receive_failures += 1
                return
            response = self._responder.respond(data, _address(peer), now)
            if response is None:
                continue
            try:
                sock.sendmsg([response], _reply_from(ancillary), 0, peer)
            except OSError:
                self.send_failures += 1


async def start_stun_server(hosts: str | Sequence[str], port: int, *, software: str | None = None) -> StunServer:
    """Answer on every address of `hosts`, all on one port (0: a free one, see `addresses`).

    "" stands for all addresses of both families; only then may IPv6 be missing on the machine. Raises OSError
    when an address cannot be had.
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
                    log.warning("STUN: no IPv6 on this machine, answering over IPv4 only")
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
    """Ancillary data that makes the kernel send from the address the request was sent to."""
    for level, kind, value in ancillary:
        if (level, kind) == (socket.IPPROTO_IP, _IP_PKTINFO) and len(value) >= _PKTINFO4.size:
            _, destination, _ = _PKTINFO4.unpack_from(value)
            # The interface stays open (0): the way back is the routing table's to choose.
            return [(level, kind, _PKTINFO4.pack(0, destination, bytes(4)))]
        if (level, kind) == (socket.IPPROTO_IPV6, socket.IPV6_PKTINFO) and len(value) >= _PKTINFO6.size:
            destination, index = _PKTINFO6.unpack_from(value)
            link_local = IPv6Address(destination).is_link_local
            return [(level, kind, _PKTINFO6.pack(destination, index if link_local else 0))]
    return []
