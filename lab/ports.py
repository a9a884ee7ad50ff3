"""Gives the emulator its frames: from a TAP device, or a packet socket on one end of a veth pair.

The interface that the host sees has the same name, address and behaviour either way. TAP is the
first choice; the packet socket serves where we may not open /dev/net/tun (unprivileged, in many
containers).
"""

from __future__ import annotations

import errno
import os
import socket
import struct
from typing import Protocol

from lab import kernel

# Longest frame: an Ethernet header and a jumbo packet.
MAX_FRAME_BYTES = 9216
# linux/if_packet.h
_SOL_PACKET = 263
_PACKET_IGNORE_OUTGOING = 23
_SO_RCVBUFFORCE = 33
_ETH_P_ALL = 3
# Room for a burst between two turns of the emulator's loop.
_SOCKET_BUFFER_BYTES = 4 << 20
# The receiving interface is down, or (EIO of a TAP) was never up.
_DOWN = frozenset({errno.EIO, errno.ENETDOWN, errno.ENXIO})
_NOTHING_TO_READ = frozenset({errno.EAGAIN, errno.EINTR, errno.ENETDOWN, errno.EIO})


class Port(Protocol):
    """One end of the link."""

    def fileno(self) -> int:
        """Return a descriptor that is readable when a frame waits."""

    def read(self) -> bytes | None:
        """Return the next Ethernet frame that the host sent; None if none waits."""

    def write(self, frame: bytes) -> bool:
        """Hand the host an Ethernet frame; return False if its interface is down."""

    def set_carrier(self, *, on: bool) -> None:
        """Plug or unplug the cable, as the host sees it."""

    def kernel_drops(self) -> int:
        """Frames that the kernel lost before the emulator could read them (it was too slow)."""


class TapPort:
    """A TAP device, made in the current network namespace."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._fd = kernel.open_tap(name)
        # Opened here and kept open, so that it keeps showing this namespace.
        self._counters = os.open("/proc/thread-self/net/dev", os.O_RDONLY | os.O_CLOEXEC)

    def fileno(self) -> int:
        """See `Port`."""
        return self._fd

    def read(self) -> bytes | None:
        """See `Port`."""
        try:
            return os.read(self._fd, MAX_FRAME_BYTES)
        except OSError as error:
            if error.errno in _NOTHING_TO_READ:
                return None
            raise

    def write(self, frame: bytes) -> bool:
        """See `Port`."""
        try:
            os.write(self._fd, frame)
        except OSError as error:
            if error.errno in _DOWN:
                return False
            raise
        return True

    def set_carrier(self, *, on: bool) -> None:
        """See `Port`."""
        kernel.set_tap_carrier(self._fd, on=on)

    def kernel_drops(self) -> int:
        """See `Port`."""
        for line in os.pread(self._counters, 1 << 16, 0).decode().splitlines():
            name, colon, counters = line.partition(":")
            if colon and name.strip() == self._name:
                return int(counters.split()[11])  # 8 receive columns, then bytes, packets, errs, drop
        return 0


class PacketPort:
    """A packet socket on interface `name` (the far end of a veth pair) in the current namespace."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._lost = 0
        self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW | socket.SOCK_NONBLOCK, 0)
        self._socket.setsockopt(_SOL_PACKET, _PACKET_IGNORE_OUTGOING, 1)
        for option in (_SO_RCVBUFFORCE, socket.SO_RCVBUF):  # the first needs a privilege we may lack
            try:
                self._socket.setsockopt(socket.SOL_SOCKET, option, _SOCKET_BUFFER_BYTES)
                break
            except PermissionError:
                continue
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SOCKET_BUFFER_BYTES)
        self._socket.bind((name, _ETH_P_ALL))

    def fileno(self) -> int:
        """See `Port`."""
        return self._socket.fileno()

    def read(self) -> bytes | None:
        """See `Port`."""
        try:
            return self._socket.recv(MAX_FRAME_BYTES)
        except OSError as error:
            if error.errno in _NOTHING_TO_READ:
                return None
            raise

    def write(self, frame: bytes) -> bool:
        """See `Port`."""
        try:
            self._socket.send(frame)
        except OSError as error:
            if error.errno in _DOWN or error.errno in (errno.EAGAIN, errno.ENOBUFS):
                return False
            raise
        return True

    def set_carrier(self, *, on: bool) -> None:
        """See `Port`."""
        kernel.set_interface_up(self._name, on=on)

    def kernel_drops(self) -> int:
        """See `Port`."""
        statistics = self._socket.getsockopt(_SOL_PACKET, 6, 8)  # PACKET_STATISTICS, reset by reading
        self._lost += struct.unpack("II", statistics)[1]
        return self._lost
