"""Runs one TCP connection, or one multipath TCP connection of the kernel, with length-prefixed messages."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from typing import TYPE_CHECKING, Any

from bench.dataplane.calling import HEADER, Caller, Compute, Plan, usage
from bench.dataplane.remote import serve

if TYPE_CHECKING:
    from collections.abc import Callable

_LENGTH = struct.Struct("<I")
_BUFFER_BYTES = 4 << 20
CONNECT_TIMEOUT_S = 5.0
# linux/in.h and linux/mptcp.h
_IPPROTO_MPTCP = 262
_SOL_MPTCP = 284
_MPTCP_INFO = 1


class TcpProgram:
    """A client or server, depending on whether `listen` or `connect` comes first."""

    def __init__(self) -> None:
        self._connection: socket.socket | None = None
        self._caller = Caller(self._send)
        self._answer_bytes = HEADER.size
        self._compute = Compute()

    def listen(self, *, multipath: bool, answer_bytes: int = HEADER.size, compute: dict[str, Any] | None = None) -> int:
        """Serve on a free port of all addresses, as `compute` (arguments of `Compute`) says, and return the port."""
        self._answer_bytes = answer_bytes
        self._compute = Compute(**(compute or {}))
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM, _IPPROTO_MPTCP if multipath else 0)
        listener.bind(("0.0.0.0", 0))
        listener.listen()
        threading.Thread(target=self._accept, args=(listener,), daemon=True).start()
        return int(listener.getsockname()[1])

    def connect(self, host: str, port: int, *, multipath: bool) -> None:
        """Connect to a server."""
        sock = self._connection = socket.socket(socket.AF_INET, socket.SOCK_STREAM, _IPPROTO_MPTCP if multipath else 0)
        sock.settimeout(CONNECT_TIMEOUT_S)
        sock.connect((host, port))
        sock.settimeout(None)
        _prepare(sock)
        self._start(sock, lambda _sock, message, now: self._caller.answered(message, now))

    def subflows(self) -> int:
        """Return how many paths multipath TCP uses besides the first; raises OSError if it fell back to TCP."""
        assert self._connection is not None
        return self._connection.getsockopt(_SOL_MPTCP, _MPTCP_INFO, 128)[0]

    def call(self, **plan: Any) -> dict[str, Any]:
        """Send a plan's requests."""
        return self._caller.call(Plan(**plan))

    def usage(self) -> dict[str, float]:
        """Return processor seconds and peak of resident bytes."""
        return usage()

    def close(self) -> None:
        """End; the threads are daemons."""

    def _accept(self, listener: socket.socket) -> None:
        while True:
            sock, _ = listener.accept()
            _prepare(sock)
            self._start(sock, self._on_request)

    def _on_request(self, sock: socket.socket, message: bytes, _now: float) -> None:
        self._compute.serve()
        answer = message[: self._answer_bytes]
        sock.sendall(_LENGTH.pack(len(answer)) + answer)

    def _send(self, _number: int, data: bytes) -> None:
        assert self._connection is not None
        with contextlib.suppress(OSError):  # the kernel gave up the connection: everything that follows is lost
            self._connection.sendall(_LENGTH.pack(len(data)) + data)

    @staticmethod
    def _start(sock: socket.socket, on_message: Callable[[socket.socket, bytes, float], None]) -> None:
        threading.Thread(target=_receive, args=(sock, on_message), daemon=True).start()


def _prepare(sock: socket.socket) -> None:
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)


def _receive(sock: socket.socket, on_message: Callable[[socket.socket, bytes, float], None]) -> None:
    with sock, contextlib.suppress(OSError), sock.makefile("rb") as stream:
        while len(length := stream.read(_LENGTH.size)) == _LENGTH.size:
            message = stream.read(_LENGTH.unpack(length)[0])
            on_message(sock, message, time.monotonic())


if __name__ == "__main__":
    serve(TcpProgram())
