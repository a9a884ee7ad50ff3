"""Runs plain UDP: a message in datagrams of 1200 bytes goes over every given path, without repetition or pacing.

datagram   number u64, total u32, offset u32, bytes of the message from the offset on
"""

from __future__ import annotations

import contextlib
import selectors
import socket
import struct
import threading
import time
from typing import TYPE_CHECKING, Any

from bench.dataplane.calling import HEADER, Caller, Plan, usage
from bench.dataplane.remote import serve

if TYPE_CHECKING:
    from collections.abc import Callable

DATAGRAM_BYTES = 1200
_PREFIX = struct.Struct("<QII")
_BODY_BYTES = DATAGRAM_BYTES - _PREFIX.size
_BUFFER_BYTES = 4 << 20
_SO_RCVBUFFORCE = 33
_MAX_INCOMPLETE = 1024


class UdpProgram:
    """A client or server, depending on whether `listen` or `connect` comes first."""

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()
        self._paths: list[tuple[socket.socket, tuple[str, int]]] = []
        self._caller = Caller(self._send)
        self._answer_bytes = HEADER.size
        self._one_way: list[tuple[int, float]] = []

    def listen(self, answer_bytes: int = HEADER.size) -> int:
        """Serve on a free port of all addresses, and return it."""
        self._answer_bytes = answer_bytes
        sock = self._open(None)
        sock.bind(("0.0.0.0", 0))
        self._run(self._on_request)
        return int(sock.getsockname()[1])

    def connect(self, paths: list[tuple[str | None, str, int]]) -> None:
        """Use these paths: interface to bind to (None lets the route decide), server's address and port."""
        self._paths = [(self._open(device), (host, port)) for device, host, port in paths]
        self._run(self._on_answer)

    def call(self, **plan: Any) -> dict[str, Any]:
        """Send a plan's requests."""
        return self._caller.call(Plan(**plan))

    def take_one_way(self) -> list[tuple[int, float]]:
        """Return number and one-way seconds of every request since the last call."""
        taken, self._one_way = self._one_way, []
        return taken

    def usage(self) -> dict[str, float]:
        """Return processor seconds and peak of resident bytes."""
        return usage()

    def close(self) -> None:
        """End; the threads are daemons."""

    def _open(self, device: str | None) -> socket.socket:
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        with contextlib.suppress(PermissionError):
            sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _BUFFER_BYTES)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
        if device is not None:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, device.encode())
        self._selector.register(sock, selectors.EVENT_READ)
        return sock

    def _run(self, on_message: Callable[[socket.socket, tuple[str, int], bytearray, float], None]) -> None:
        threading.Thread(target=self._receive, args=(on_message,), daemon=True).start()

    def _receive(self, on_message: Callable[[socket.socket, tuple[str, int], bytearray, float], None]) -> None:
        parts: dict[tuple[tuple[str, int], int], tuple[bytearray, set[int]]] = {}
        while True:
            for key, _ in self._selector.select():
                sock = key.fileobj
                assert isinstance(sock, socket.socket)
                try:
                    datagram, source = sock.recvfrom(2048)
                except OSError:
                    continue
                number, total, offset = _PREFIX.unpack_from(datagram)
                message, have = parts.setdefault((source, number), (bytearray(total), set()))
                message[offset : offset + len(datagram) - _PREFIX.size] = datagram[_PREFIX.size :]
                have.add(offset)
                if len(have) * _BODY_BYTES >= total:
                    del parts[source, number]
                    on_message(sock, source, message, time.monotonic())
                elif len(parts) > _MAX_INCOMPLETE:
                    del parts[next(iter(parts))]

    def _on_request(self, sock: socket.socket, source: tuple[str, int], message: bytearray, now: float) -> None:
        number, sent = HEADER.unpack_from(message)
        self._one_way.append((number, now - sent))
        self._send_message(sock, source, number, message[: self._answer_bytes])

    def _on_answer(self, _sock: socket.socket, _source: tuple[str, int], message: bytearray, now: float) -> None:
        self._caller.answered(message, now)

    def _send(self, number: int, data: bytes) -> None:
        for sock, server in self._paths:
            self._send_message(sock, server, number, data)

    @staticmethod
    def _send_message(sock: socket.socket, to: tuple[str, int], number: int, data: bytes | bytearray) -> None:
        view = memoryview(data)
        for offset in range(0, len(data), _BODY_BYTES):
            with contextlib.suppress(OSError):
                sock.sendto(_PREFIX.pack(number, len(data), offset) + view[offset : offset + _BODY_BYTES], to)


if __name__ == "__main__":
    serve(UdpProgram())
