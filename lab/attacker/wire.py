"""Plays an attacker on the path: it sees the UDP datagrams that pass an interface, and sends some of its own.

It uses packet sockets (packet(7)) on the lab's routers and hosts. Its datagrams may carry any source address.
"""

from __future__ import annotations

import socket
import struct
import time
from typing import TYPE_CHECKING, NamedTuple, Self

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

    from lab import Host
    from plr.protos.model.ids import Address

ETHERNET_BYTES = 14
_ETH_P_ALL = 3
_ETHERTYPE_IPV4 = b"\x08\x00"
_ETHERTYPE_IPV6 = b"\x86\xdd"
_UDP = 17
_LONGEST = 1 << 17
_RECEIVE_BUFFER_BYTES = 16 << 20
_SO_RCVBUFFORCE = 33
_IPV4 = struct.Struct(">BBHHHBBH4s4s")
_IPV6 = struct.Struct(">IHBB16s16s")
_UDP_HEADER = struct.Struct(">HHHH")


class Captured(NamedTuple):
    """A UDP datagram as it was on the wire."""

    interface: str
    ethernet: bytes
    """The 14-byte header in front, with which it takes the same way again."""
    source: Address
    destination: Address
    payload: bytes
    outgoing: bool
    """Whether it left by the interface rather than came in."""

    def frame(self) -> bytes:
        """Return the whole frame, rebuilt with correct checksums."""
        family = socket.AF_INET6 if ":" in self.source[0] else socket.AF_INET
        source, destination = (socket.inet_pton(family, host) for host, _ in (self.source, self.destination))
        length = _UDP_HEADER.size + len(self.payload)
        unchecked = _UDP_HEADER.pack(self.source[1], self.destination[1], length, 0) + self.payload
        pseudo = source + destination + struct.pack(">II", length, _UDP)
        # RFC 768, RFC 8200 section 8.1: 0 would mean that there is no checksum.
        checksum = _checksum(pseudo + unchecked) or 0xFFFF
        udp = unchecked[:6] + checksum.to_bytes(2, "big") + unchecked[8:]
        if family == socket.AF_INET6:
            return (
                self.ethernet[:12] + _ETHERTYPE_IPV6 + _IPV6.pack(6 << 28, length, _UDP, 64, source, destination) + udp
            )
        header = _IPV4.pack(0x45, 0, _IPV4.size + length, 0, 0, 64, _UDP, 0, source, destination)
        checked = header[:10] + _checksum(header).to_bytes(2, "big") + header[12:]
        return self.ethernet[:12] + _ETHERTYPE_IPV4 + checked + udp


def _checksum(data: bytes) -> int:
    """Return the Internet checksum (RFC 1071)."""
    data += bytes(len(data) & 1)
    total: int = sum(struct.unpack(f">{len(data) // 2}H", data))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF


def parse(interface: str, frame: bytes, *, outgoing: bool) -> Captured | None:
    """Return the UDP datagram in an Ethernet frame, or None if there is none (or a fragment of one)."""
    ethernet, packet = frame[:ETHERNET_BYTES], frame[ETHERNET_BYTES:]
    if ethernet[12:] == _ETHERTYPE_IPV4 and len(packet) >= _IPV4.size:
        first, _, total, _, fragment, _, protocol, _, source, destination = _IPV4.unpack_from(packet)
        head = 4 * (first & 15)
        if fragment & 0x3FFF:
            return None
    elif ethernet[12:] == _ETHERTYPE_IPV6 and len(packet) >= _IPV6.size:
        _, length, protocol, _, source, destination = _IPV6.unpack_from(packet)
        head = _IPV6.size
        total = length and head + length
    else:
        return None
    if protocol != _UDP or len(packet) < head + _UDP_HEADER.size:
        return None
    family = socket.AF_INET if len(source) == 4 else socket.AF_INET6
    from_port, to_port, _, _ = _UDP_HEADER.unpack_from(packet, head)
    # A run of datagrams that the kernel has not cut yet may have a length of 0.
    return Captured(
        interface,
        ethernet,
        (socket.inet_ntop(family, source), from_port),
        (socket.inet_ntop(family, destination), to_port),
        packet[head + _UDP_HEADER.size : total or None],
        outgoing,
    )


class Tap:
    """Listens at an interface of a lab machine and sends frames out of it. Use it in a `with` block."""

    def __init__(self, host: Host, interface: str) -> None:
        self.interface = interface
        self._socket = host.socket(socket.AF_PACKET, socket.SOCK_RAW)
        self._socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BUFFER_BYTES)
        self._socket.bind((interface, _ETH_P_ALL))
        self._socket.setblocking(False)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._socket.close()

    def frames(self) -> list[tuple[bytes, bool]]:
        """Return every frame that passed since the last time, and whether it left by the interface."""
        found: list[tuple[bytes, bool]] = []
        while True:
            try:
                data, (_, _, kind, _, _) = self._socket.recvfrom(_LONGEST)
            except BlockingIOError:
                return found
            found.append((data, kind == socket.PACKET_OUTGOING))

    def take(self) -> list[Captured]:
        """Return the UDP datagrams that passed since the last time."""
        parsed = [parse(self.interface, data, outgoing=outgoing) for data, outgoing in self.frames()]
        return [one for one in parsed if one is not None]

    def wait_for(self, wanted: Callable[[Captured], bool], count: int = 1, timeout_s: float = 20.0) -> list[Captured]:
        """Listen until `count` such datagrams have passed; raises TimeoutError."""
        found: list[Captured] = []
        end = time.monotonic() + timeout_s
        while len(found) < count:
            if time.monotonic() > end:
                raise TimeoutError(f"{self.interface}: {len(found)} of {count} datagrams in {timeout_s:g} s")
            found += filter(wanted, self.take())
            time.sleep(0.01)
        return found

    def send(self, datagram: Captured) -> None:
        """Put a datagram on the wire; it goes to the neighbour that its Ethernet header names."""
        self._socket.send(datagram.frame())
