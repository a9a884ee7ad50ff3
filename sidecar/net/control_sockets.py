"""Opens the sockets of the control stream: the private one that gRPC connects to, and TCP bound to an interface."""

from __future__ import annotations

import os
import secrets
import socket
import struct
from typing import TYPE_CHECKING

from plr.sidecar.core.control.watch import KEEPALIVE_S, Seen

if TYPE_CHECKING:
    from plr.protos.model.ids import Address
    from plr.sidecar.core.control.ways import Way

USER_TIMEOUT_MS = 5_000
"""Time without acknowledgement after which TCP gives up (TCP_USER_TIMEOUT); the same as on gRPC's own sockets."""

NAME_BYTES = 16
"""Length of the private socket's name: nobody can guess it in advance, and it is new for every stream."""

BACKLOG = 8
"""Room for gRPC's own connection besides those that others make meanwhile."""

_UCRED = struct.Struct("3i")
# struct tcp_info of linux/tcp.h: eight bytes, then 32-bit numbers, some of which these are.
_TCP_INFO_BYTES = 104
_PROBES = 3
_UNACKED, _LAST_DATA_RECV_MS, _LAST_ACK_RECV_MS, _RTT_US, _RTTVAR_US = 24, 52, 56, 68, 72


class NotAllowedError(OSError):
    """The system does not let us bind to an interface."""


def listen_privately() -> tuple[socket.socket, str]:
    """Return a listening Unix socket and its name for gRPC.

    The socket is in the abstract namespace: it leaves nothing on disk, however the program ends, and needs no writable
    one. Anybody on this host who finds it may connect: `is_ours` tells who did.
    """
    name = f"plr-{secrets.token_hex(NAME_BYTES)}"
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
    try:
        listening.setblocking(False)
        listening.bind(f"\0{name}")
        listening.listen(BACKLOG)
    except BaseException:
        listening.close()
        raise
    return listening, f"unix-abstract:{name}"


def is_ours(accepted: socket.socket) -> bool:
    """Return whether this very process is at the other end, according to the kernel."""
    pid, _, _ = _UCRED.unpack(accepted.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _UCRED.size))
    return bool(pid == os.getpid())


def open_stream(way: Way) -> socket.socket:
    """Return a TCP socket for this way, not connected yet.

    Raises:
        NotAllowedError: it may not be bound to an interface.
        OSError: the kernel refuses it for another reason.
    """
    family = socket.AF_INET6 if ":" in way.address[0] else socket.AF_INET
    sock = socket.socket(family, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
    try:
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, USER_TIMEOUT_MS)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, KEEPALIVE_S)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, KEEPALIVE_S)
        if way.interface is not None:
            try:
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, way.interface.encode())
            except PermissionError as error:
                raise NotAllowedError(error.errno, error.strerror) from error
    except BaseException:
        sock.close()
        raise
    return sock


def own_address(sock: socket.socket) -> str:
    """Return the local address of a connected socket."""
    host: Address = sock.getsockname()[:2]
    return host[0]


def look(sock: socket.socket) -> Seen:
    """Ask the kernel how a connection fares; raises OSError."""
    info = sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _TCP_INFO_BYTES)

    def number(offset: int) -> int:
        return int.from_bytes(info[offset : offset + 4], "little" if struct.pack("=H", 1)[0] else "big")

    return Seen(
        unacked=number(_UNACKED) > 0 or info[_PROBES] > 0,
        quiet_s=min(number(_LAST_DATA_RECV_MS), number(_LAST_ACK_RECV_MS)) / 1e3,
        rtt_s=(number(_RTT_US) + 4 * number(_RTTVAR_US)) / 1e6,
    )
