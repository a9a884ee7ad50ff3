"""Opens one UDP socket for one interface, and converts addresses between the forms of sockets and cores."""

from __future__ import annotations

import enum
import errno
import functools
import logging
import socket
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.protos.model.ids import Address
    from plr.sidecar.net.interfaces import Interface

log = logging.getLogger(__name__)

RECEIVE_BUFFER_BYTES = 4 << 20
"""A quarter of the largest message: what arrives while the interpreter is busy has to wait here."""
SEND_BUFFER_BYTES = 512 << 10
"""Some milliseconds of a fast link: more would only go stale there, where it cannot be taken back."""

ADDRESS_CACHE_ENTRIES = 4096
"""Size of the cache, more than the addresses of all peers of one sidecar; forged sources can only empty it."""

# Constants of linux/in.h, linux/in6.h and asm/socket.h that the socket module lacks.
_IP_MTU_DISCOVER = 10
_IPV6_MTU_DISCOVER = 23
_PMTUDISC_PROBE = 3
_IP_UNICAST_IF = 50
_IPV6_UNICAST_IF = 76
_SO_SNDBUFFORCE = 32
_SO_RCVBUFFORCE = 33

_NO_IPV6 = frozenset({errno.EAFNOSUPPORT, errno.EADDRNOTAVAIL, errno.EPROTONOSUPPORT})


class BoundTo(enum.StrEnum):
    """The means that keeps a socket on its interface."""

    DEVICE = "device"
    """SO_BINDTODEVICE: the socket sends and receives over this interface only."""
    ADDRESS = "address"
    """The interface's address, one family only: the kernel refused to bind to the device."""


class DataSocket(NamedTuple):
    """An open socket and what it is bound to."""

    socket: socket.socket
    bound_to: BoundTo


def open_socket(interface: Interface, port: int) -> DataSocket:
    """Open the non-blocking UDP socket of `interface` on `port`, 0 for any free one.

    One socket serves IPv4 and IPv6 where the host has both. Linux before 5.7 lets only CAP_NET_RAW bind to a
    device, and a sandbox may forbid it to anyone: there the socket is bound to the interface's first address
    instead, IPv4 preferred. Raises OSError, such as EADDRINUSE for a taken port.
    """
    try:
        return DataSocket(_open(lambda sock: _bind_to_device(sock, interface, port)), BoundTo.DEVICE)
    except PermissionError:
        if not interface.addresses:
            raise
        address = min(interface.addresses, key=lambda text: ":" in text)
        log.warning(
            "%s: not allowed to bind to the device (CAP_NET_RAW): bound to its address %s instead",
            interface.name,
            address,
        )
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    sock = _open(lambda sock: _bind_to_address(sock, interface, (address, port)), family)
    return DataSocket(sock, BoundTo.ADDRESS)


@functools.lru_cache(ADDRESS_CACHE_ENTRIES)
def normalise(address: tuple[Any, ...]) -> Address:
    """Return recvfrom's sender address in the form of the cores: IPv4-mapped addresses become IPv4."""
    host, port = address[0], address[1]
    if host.startswith("::ffff:") and "." in host:
        host = host[len("::ffff:") :]
    return host, port


@functools.lru_cache(ADDRESS_CACHE_ENTRIES)
def to_sockaddr(family: int, address: Address) -> tuple[str, int] | tuple[str, int, int, int] | None:
    """Return `address` in the form for sendto on a socket of `family`, or None when that socket cannot reach it.

    Raises ValueError for a host that is not an IP address: sendto would look it up and block.
    """
    host, port = address
    ip = ip_address(host)
    if family == socket.AF_INET6:
        return (f"::ffff:{host}" if isinstance(ip, IPv4Address) else host), port, 0, 0
    return None if isinstance(ip, IPv6Address) else (host, port)


def _open(bind: Callable[[socket.socket], None], family: int | None = None) -> socket.socket:
    """Return a bound socket with our options; without `family` dual-stack, or IPv4 where IPv6 is off."""
    try:
        sock = socket.socket(family or socket.AF_INET6, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        try:
            _set_options(sock)
            bind(sock)
        except BaseException:
            sock.close()
            raise
    except OSError as error:
        if family is None and error.errno in _NO_IPV6:
            return _open(bind, socket.AF_INET)
        raise
    return sock


def _set_options(sock: socket.socket) -> None:
    sock.setblocking(False)
    _set_buffer(sock, _SO_RCVBUFFORCE, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
    _set_buffer(sock, _SO_SNDBUFFORCE, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
    # No fragmentation (one lost fragment loses the datagram), and no trust in ICMP, which anybody may forge.
    sock.setsockopt(socket.IPPROTO_IP, _IP_MTU_DISCOVER, _PMTUDISC_PROBE)
    if sock.family == socket.AF_INET6:
        sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
        sock.setsockopt(socket.IPPROTO_IPV6, _IPV6_MTU_DISCOVER, _PMTUDISC_PROBE)


def _set_buffer(sock: socket.socket, forced: int, polite: int, size: int) -> None:
    try:
        sock.setsockopt(socket.SOL_SOCKET, forced, size)
    except PermissionError:
        sock.setsockopt(socket.SOL_SOCKET, polite, size)
        # The kernel doubles the size it grants, for its own bookkeeping.
        granted = sock.getsockopt(socket.SOL_SOCKET, polite) // 2
        if granted < size:
            log.info("socket buffer of %d bytes instead of %d: raise net.core", granted, size)


def _bind_to_device(sock: socket.socket, interface: Interface, port: int) -> None:
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, interface.name.encode())
    sock.bind(("::", port) if sock.family == socket.AF_INET6 else ("0.0.0.0", port))  # noqa: S104 - bound to the device


def _bind_to_address(sock: socket.socket, interface: Interface, address: tuple[str, int]) -> None:
    sock.bind(address)
    # This needs no capability. The address alone does not select the way out: Linux routes by destination.
    if sock.family == socket.AF_INET:
        sock.setsockopt(socket.IPPROTO_IP, _IP_UNICAST_IF, socket.htonl(interface.index))
    else:
        sock.setsockopt(socket.IPPROTO_IPV6, _IPV6_UNICAST_IF, socket.htonl(interface.index))
