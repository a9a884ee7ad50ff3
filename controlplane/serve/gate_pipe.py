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
    """One of the two connections; what it receives before `join` waits, and it is not read further."""

    def __init__(self, on_lost: Callable[[], None] | None = None) -> None:
        self._transport: asyncio.Transport | None = None
        self._other: PipeEnd | None = None
        self._early = bytearray()
        self._on_lost = on_lost
        self.lost = False
        self.received_at = -math.inf
        """When it passed something on last, in monotonic seconds."""

    @property
    def transport(self) -> asyncio.Transport:
        """The connection; there once the event loop has made it."""
        assert self._transport is not None
        return self._transport

    @staticmethod
    def join(one: PipeEnd, other: PipeEnd) -> None:
        """From now on what one receives is written to the other; both have to be connected."""
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
        """End the connection once what was written to it is out."""
        # Closed once it is closing, asyncio's TLS transport forgets its connection: `abort` does nothing, or raises.
        if self._transport is not None and not self._transport.is_closing():
            self._transport.close()

    def abort(self) -> None:
        """End the connection now."""
        if self._transport is not None:
            self._transport.abort()

    def unread(self) -> bool:
        """Whether something has arrived that is not even read from the socket yet."""
        if self.lost or self._transport is None:
            return False
        sock = self._transport.get_extra_info("socket")
        if sock is None or sock.fileno() < 0:
            # TLS has lost its connection, and tells us in the next turn of the loop.
            return False
        waiting = fcntl.ioctl(sock.fileno(), termios.FIONREAD, bytes(4))
        return bool(struct.unpack("i", waiting)[0])

    # ── asyncio.Protocol ──

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """The connection is there; reading waits for `join`."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        transport.pause_reading()

    def data_received(self, data: bytes) -> None:
        """Pass it on."""
        self.received_at = time.monotonic()
        if self.lost:
            return
        if self._other is None:
            self._early += data
        else:
            self._other.transport.write(data)

    def eof_received(self) -> bool:
        """gRPC has no use for half a connection: both ends close."""
        return False

    def pause_writing(self) -> None:
        """This end is slow: the other one is not read meanwhile."""
        if self._other is not None and not self._other.lost:
            self._other.transport.pause_reading()

    def resume_writing(self) -> None:
        """This end has caught up."""
        if self._other is not None and not self._other.lost:
            self._other.transport.resume_reading()

    def connection_lost(self, exc: Exception | None) -> None:
        """The other end has nobody to talk to any more."""
        self.lost = True
        if self._on_lost is not None:
            self._on_lost()
            self._on_lost = None
        other = self._other
        if other is None:
            return
        other.close()
        if other.lost:
            # The garbage collector does not look at what has been there for long (`protos.program.interpreter`).
            self._other = other._other = None
