"""Lets the lab's processes talk: one JSON object a line over an inherited stream socket."""

from __future__ import annotations

import json
import socket
from typing import Any

from lab.errors import LabError

# SCM_MAX_FD of the kernel.
_MAX_DESCRIPTORS = 253


class LineSocket:
    """JSON lines over a connected stream socket, blocking or polled."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection
        self._received = bytearray()
        self._descriptors: list[int] = []

    def fileno(self) -> int:
        """Return a descriptor that is readable when more may be received."""
        return self._socket.fileno()

    def settimeout(self, seconds: float | None) -> None:
        """Set how long `send` and `receive` wait before they raise TimeoutError."""
        self._socket.settimeout(seconds)

    def send(self, message: dict[str, Any]) -> None:
        """Send one message; raises OSError."""
        self._socket.sendall(json.dumps(message).encode() + b"\n")

    def send_with_descriptors(self, message: dict[str, Any], descriptors: list[int]) -> None:
        """Send one short message with open files; raises OSError."""
        socket.send_fds(self._socket, [json.dumps(message).encode() + b"\n"], descriptors)

    def take_descriptor(self) -> int:
        """Return the next of the open files that came with messages; raises LabError if there is none."""
        if not self._descriptors:
            raise LabError("the lab's control socket: no open file came along")
        return self._descriptors.pop(0)

    def receive(self) -> dict[str, Any] | None:
        """Wait for the next message and return it; None if the other side is gone. Raises LabError on garbage."""
        while b"\n" not in self._received:
            if not self._fill():
                return None
        return self._pop()

    def receive_ready(self) -> list[dict[str, Any]] | None:
        """Return the complete messages once the socket is readable; None if the other side is gone."""
        if not self._fill():
            return None
        messages = []
        while b"\n" in self._received:
            messages.append(self._pop())
        return messages

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _fill(self) -> bool:
        try:
            data, descriptors, _, _ = socket.recv_fds(self._socket, 1 << 16, _MAX_DESCRIPTORS, socket.MSG_CMSG_CLOEXEC)
        except ConnectionError:
            return False
        self._received += data
        self._descriptors += descriptors
        return bool(data)

    def _pop(self) -> dict[str, Any]:
        line, _, rest = self._received.partition(b"\n")
        self._received = bytearray(rest)
        try:
            message = json.loads(line)
        except ValueError as error:
            raise LabError(f"garbage on the lab's control socket: {error}") from None
        if not isinstance(message, dict):
            raise LabError("garbage on the lab's control socket: not an object")
        return message
