"""Asks a running sidecar over its local socket, and trusts nobody else.

In a folder that others may write, any program may listen there: the kernel says whose it is, and its answers are read
within bounds and checked.
"""

from __future__ import annotations

import json
import os
import pwd
import socket
import struct
import time
from typing import TYPE_CHECKING, Any

from plr.protos.base.errors import DecodeError
from plr.protos.base.printable import escaped
from plr.sidecar.local.answers import decode_line
from plr.sidecar.local.entrance import MAX_SOCKET_BYTES, for_group
from plr.sidecar.local.peer import user_of

if TYPE_CHECKING:
    from pathlib import Path
    from types import TracebackType

    from plr.sidecar.local.answers import Line

CONNECT_S = 3.0
STATE_S = 10.0
"""Longest time for the answer about the sidecar's state; thousands of paths come in a second."""
MAX_ANSWER_LINE_BYTES = 1 << 20
MAX_STATE_BYTES = 8 << 20
"""Longest whole answer: some 20,000 paths."""
ACCOUNT = "plr"
"""The systemd unit's user."""
_REPEATED = frozenset({"paths", "interfaces", "mapped", "ways"})
"""Parts that come repeatedly."""
_BUSY = "the sidecar is busy with others: try again"
_STRANGER = "the program that answers at the socket is not a sidecar"
_TIMEVAL = struct.Struct("ll")


class LocalError(Exception):
    """There is no answer; the text is one line, fit for a terminal."""

    def __init__(self, text: str) -> None:
        super().__init__(escaped(text))


class LocalBusyError(LocalError):
    """The sidecar runs, and is answering others."""


class LocalRefusedError(LocalError):
    """This user may not ask."""


class LocalClient:
    """A connection to the sidecar whose socket is at `path`; raises LocalError when there is none.

    `owners`: users whose sidecar it may be, besides root, the unit's user and this one.
    """

    def __init__(self, path: Path, owners: frozenset[int] = frozenset()) -> None:
        self._received = bytearray()
        self._id = 0
        self._sock = _connect(path)
        user = user_of(self._sock)
        if user not in {0, os.geteuid(), *_unit_user(), *owners}:
            self._sock.close()
            raise LocalError(f"{path}: user {user} listens there and is neither root nor {ACCOUNT} nor this user")

    def __enter__(self) -> LocalClient:
        return self

    def __exit__(self, _t: type[BaseException] | None, _e: BaseException | None, _b: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """End the connection."""
        self._sock.close()

    def state(self) -> dict[str, Any]:
        """Return the parts of the sidecar's state; a part that comes repeatedly is one list."""
        mine = self._ask({"ask": "state"})
        end = time.monotonic() + STATE_S
        state: dict[str, Any] = {name: [] for name in _REPEATED}
        size = 0
        while True:
            line, line_bytes = self._next(end - time.monotonic())
            size += line_bytes
            if size > MAX_STATE_BYTES:
                raise LocalError(f"{_STRANGER}: more than {MAX_STATE_BYTES} bytes")
            if not line_bytes:
                raise LocalBusyError("the sidecar does not answer: it is stopped, or very busy")
            if line is None:
                continue
            if "error" in line:
                raise refusal(line)
            if line.get("id") != mine:
                continue
            if line.get("end"):
                return state
            part, value = line.get("part"), line.get("value")
            if part not in _REPEATED:
                state[str(part)] = value
            elif isinstance(value, list):
                state[part] += value
            else:
                state[part].append(value)

    def ping(self, peer: str, interface: str | None, size: int) -> int:
        """Send a ping over each path to a peer; return the request's id, which each answer's line repeats."""
        return self._ask({"ask": "ping", "peer": peer, "interface": interface, "size": size})

    def next_line(self, timeout_s: float) -> Line | None:
        """Return the next line; None if none came in time."""
        end = time.monotonic() + timeout_s
        while True:
            line, line_bytes = self._next(end - time.monotonic())
            if line is not None or not line_bytes:
                return line

    def _next(self, timeout_s: float) -> tuple[Line | None, int]:
        """Return the next line (None if unknown here) and its number of bytes (0 if none came in time)."""
        end = time.monotonic() + timeout_s
        searched = 0
        while True:
            position = self._received.find(b"\n", searched)
            if position >= 0:
                line = bytes(self._received[:position])
                del self._received[: position + 1]
                return _parse(line), position + 1
            searched = len(self._received)
            if searched > MAX_ANSWER_LINE_BYTES:
                raise LocalError(f"{_STRANGER}: a line of more than {MAX_ANSWER_LINE_BYTES} bytes")
            left_s = end - time.monotonic()
            if left_s <= 0:
                return None, 0
            self._sock.settimeout(left_s)
            try:
                data = self._sock.recv(65_536)
            except TimeoutError:
                return None, 0
            except OSError as error:
                raise LocalError(f"the sidecar closed the connection: {error.strerror}") from error
            if not data:
                raise LocalBusyError("the sidecar closed the connection: it ended, or is busy with others")
            self._received += data

    def _ask(self, request: dict[str, Any]) -> int:
        self._id += 1
        self._sock.settimeout(CONNECT_S)
        try:
            self._sock.sendall(json.dumps({"id": self._id, **request}).encode() + b"\n")
        except TimeoutError:
            raise LocalBusyError("the sidecar reads nothing: it is stopped, or very busy") from None
        except OSError as error:
            # What it wrote before it closed says more.
            line = self.next_line(CONNECT_S)
            raise LocalError(str(error.strerror)) if line is None else refusal(line) from error
        return self._id


def refusal(line: Line) -> LocalError:
    """Return the error for a line that refuses a request."""
    kind = LocalBusyError if line.get("busy") else LocalError
    return kind(str(line.get("error")))


def _parse(line: bytes) -> Line | None:
    try:
        return decode_line(line)
    except DecodeError as error:
        raise LocalError(f"{_STRANGER} of this version: {error}") from error


def _connect(path: Path) -> socket.socket:
    if b"\0" in os.fsencode(path) or len(os.fsencode(for_group(path))) > MAX_SOCKET_BYTES:
        raise LocalError(f"{path}: not a valid path of a socket")
    try:
        return _connect_at(path)
    except PermissionError:
        pass  # for root and the sidecar's own user
    except OSError as error:
        raise _why(path, error) from error
    try:
        return _connect_at(for_group(path))
    except OSError as error:
        raise _why(path, error) from error


def _connect_at(path: Path) -> socket.socket:
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
    try:
        # With this, and without Python's own timeout, the kernel waits for a place in a full queue.
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _TIMEVAL.pack(int(CONNECT_S), 0))
        sock.connect(str(path))
    except OSError:
        sock.close()
        raise
    return sock


def _why(path: Path, error: OSError) -> LocalError:
    if isinstance(error, PermissionError):
        return LocalRefusedError(f"{path}: this user may not ask the sidecar: be root, or a member of the group plr")
    if isinstance(error, FileNotFoundError | ConnectionRefusedError):
        return LocalError(f"nothing listens at {path}")
    if isinstance(error, BlockingIOError):
        return LocalBusyError(f"{path}: {_BUSY}")
    return LocalError(f"{path}: {error.strerror or error}")


def _unit_user() -> set[int]:
    try:
        return {pwd.getpwnam(ACCOUNT).pw_uid}
    except KeyError:
        return set()
