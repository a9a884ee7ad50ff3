"""Asks a running sidecar over its local socket."""

from __future__ import annotations

import json
import socket
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path
    from types import TracebackType

CONNECT_S = 3.0
STATE_S = 10.0
"""How long the answer to how everything is may take; thousands of paths come in a second."""
MAX_LINE_BYTES = 1 << 20
_TIMES = frozenset({"paths", "interfaces", "mapped", "pong"})
"""Parts that come repeatedly."""

Line = dict[str, Any]


class LocalError(Exception):
    """There is no answer; the text is one line."""


class LocalClient:
    """A connection to the socket at `path`; raises LocalError when there is none."""

    def __init__(self, path: Path) -> None:
        self._received = bytearray()
        self._id = 0
        self._sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
        self._sock.settimeout(CONNECT_S)
        try:
            self._sock.connect(str(path))
        except OSError as error:
            self._sock.close()
            raise LocalError(_why(path, error)) from error

    def __enter__(self) -> LocalClient:
        return self

    def __exit__(self, _t: type[BaseException] | None, _e: BaseException | None, _b: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """End the connection."""
        self._sock.close()

    def state(self) -> dict[str, Any]:
        """Return the parts of how everything is, those that come repeatedly as one list."""
        mine = self._ask({"ask": "state"})
        end = time.monotonic() + STATE_S
        state: dict[str, Any] = {name: [] for name in _TIMES}
        while True:
            line = self.next_line(end - time.monotonic())
            if line is None:
                raise LocalError("the sidecar does not answer")
            if "error" in line:
                raise LocalError(str(line["error"]))
            if line.get("id") != mine:
                continue
            if line.get("end"):
                return state
            part, value = line.get("part"), line.get("value")
            if part not in _TIMES:
                state[str(part)] = value
            elif isinstance(value, list):
                state[part] += value
            else:
                state[part].append(value)

    def ping(self, peer: str, interface: str | None, size: int) -> int:
        """Send a ping over each path to a peer; returns the request's id, which `next_line` tells with each answer."""
        return self._ask({"ask": "ping", "peer": peer, "interface": interface, "size": size})

    def next_line(self, timeout_s: float) -> Line | None:
        """Return the next line; None: none came in time."""
        end = time.monotonic() + timeout_s
        while True:
            position = self._received.find(b"\n")
            if position >= 0:
                line = bytes(self._received[:position])
                del self._received[: position + 1]
                return _parse(line)
            left_s = end - time.monotonic()
            if left_s <= 0 or len(self._received) > MAX_LINE_BYTES:
                return None
            self._sock.settimeout(left_s)
            try:
                data = self._sock.recv(65_536)
            except TimeoutError:
                return None
            except OSError as error:
                raise LocalError(f"the sidecar closed the connection: {error.strerror}") from error
            if not data:
                raise LocalError("the sidecar closed the connection: it ended, or is busy with others")
            self._received += data

    def _ask(self, request: dict[str, Any]) -> int:
        self._id += 1
        self._sock.settimeout(CONNECT_S)
        try:
            self._sock.sendall(json.dumps({"id": self._id, **request}).encode() + b"\n")
        except OSError as error:
            # What it said before it closed tells more.
            line = self.next_line(CONNECT_S)
            raise LocalError(str((line or {}).get("error") or error.strerror or error)) from error
        return self._id


def _parse(line: bytes) -> Line:
    try:
        value = json.loads(line)
    except ValueError as error:
        raise LocalError("what answers at the socket is no sidecar") from error
    if not isinstance(value, dict):
        raise LocalError("what answers at the socket is no sidecar")
    return value


def _why(path: Path, error: OSError) -> str:
    if isinstance(error, PermissionError):
        return f"{path}: this user may not ask the sidecar: be root, or a member of the group plr"
    if isinstance(error, FileNotFoundError | ConnectionRefusedError):
        return f"nothing listens at {path}"
    return f"{path}: {error.strerror or error}"
