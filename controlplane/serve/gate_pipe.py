"""Moves bytes between two connections of one event loop, each no faster than the other takes them."""

from __future__ import annotations

import asyncio
import fcntl
import math
import struct
import termios
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


class PipeEnd(asyncio.Protocol):
    """One of the two connections; what it receives before `join` waits, and reading pauses."""

    def __init__(self, on_lost: Callable[[], None] | None = None) -> None:
        self._transport: asyncio.Transport | None = None
        self._other: PipeEnd | None = None
        self._early = bytearray()
        self._on_lost = on_lost
        self.lost = False
        self.received_at = -math.inf
        """When it last passed something on, in monotonic seconds."""

    @property
    def transport(self) -> asyncio.Transport:
        """The connection; available once the event loop has made it."""
        assert self._transport is not None
        return self._transport

    @staticmethod
    def join(one: PipeEnd, other: PipeEnd) -> None:
        """Write what one end receives to the other from now on; both must be connected."""
        one._other, other._other = other, one
        for source, sink in ((one, other), (other, one)):
            if source._early:
                sink.transport.write(bytes(source._early))
                source._early.clear()
        if one.lost or other.lost:
            one.close()
            other.close()
            return
        one.transport.resume_reading()
        other.transport.resume_reading()

    def close(self) -> None:
        """End the connection once everything written to it is sent."""
        # If closed while closing, asyncio's TLS transport forgets its connection: `abort` then does nothing, or raises.
        if self._transport is not None and not self._transport.is_closing():
            self._transport.close()

    def abort(self) -> None:
        """End the connection now."""
        if self._transport is not None:
            self._transport.abort()

    def unread(self) -> bool:
        """Return whether data has arrived that is not yet read from the socket."""
        if self.lost or self._transport is None:
            return False
        sock = self._transport.get_extra_info("socket")
        if sock is None or sock.fileno() < 0:
            # TLS has lost its connection and reports it in the next turn of the loop.
            return False
        waiting = fcntl.ioctl(sock.fileno(), termios.FIONREAD, bytes(4))
        return bool(struct.unpack("i", waiting)[0])

    # ── asyncio.Protocol ──

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the connection; pause reading until `join`."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        transport.pause_reading()

    def data_received(self, data: bytes) -> None:
        """Pass the data on."""
        self.received_at = time.monotonic()
        if self.lost:
            return
        if self._other is None:
            self._early += data
        else:
            self._other.transport.write(data)

    def eof_received(self) -> bool:
        """Close both ends: gRPC has no use for a half-closed connection."""
        return False

    def pause_writing(self) -> None:
        """Stop reading the other end while this one is slow."""
        if self._other is not None and not self._other.lost:
            self._other.transport.pause_reading()

    def resume_writing(self) -> None:
        """Read the other end again: this one has caught up."""
        if self._other is not None and not self._other.lost:
            self._other.transport.resume_reading()

    def connection_lost(self, exc: Exception | None) -> None:
        """Close the other end, which has no peer any more."""
        self.lost = True
        if self._on_lost is not None:
            self._on_lost()
            self._on_lost = None
        other = self._other
        if other is None:
            return
        other.close()
        if other.lost:
            # Break the cycle: the collector skips long-lived objects (`plr.protos.program.interpreter`).
            self._other = other._other = None
