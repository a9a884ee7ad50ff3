"""Serves a sidecar's local socket: few clients at once, none for long, whoever comes; the data plane never waits.

One thread, and no lock of anybody's is held while a client is served. What a client may cost is bounded: connections,
the bytes of a request, what waits to be read by it, requests a second, pings that are out. An answer is built piece by
piece, as the client reads it, with a pause after each, so that who has thousands of paths holds the interpreter from
nobody.
"""

from __future__ import annotations

import contextlib
import errno
import grp
import logging
import os
import selectors
import socket
import stat
import struct
import threading
import time
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from protos.errors import DecodeError
from protos.token_bucket import TokenBucket
from sidecar.local.protocol import (
    MAX_REQUEST_BYTES,
    PingRequest,
    StateRequest,
    decode_request,
    encode_end,
    encode_error,
    encode_part,
)

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from sidecar.core.path_id import PathId
    from sidecar.core.pinging import Pong

log = logging.getLogger(__name__)

GROUP = "plr"
"""Whose members may ask, beside root and the sidecar's own user."""
MAX_CONNECTIONS = 16
MAX_OF_A_USER = 8
"""Connections of one user other than root: nobody keeps all others out."""
IDLE_S = 30.0
"""A connection that asks nothing for so long is closed, ..."""
PATIENCE_S = 5.0
"""... one that has begun a request, or has not read an answer, after this."""
MAX_UNREAD_BYTES = 65_536
"""What waits to be read by a client; before more is built, it has to read."""
MAX_REQUESTS = 8
"""Of one connection, being answered."""
ACCEPTS_PER_S, ACCEPTS_AT_ONCE = 20.0, 40.0
STATES_PER_S, STATES_AT_ONCE = 4.0, 8.0
PINGS_PER_S, PINGS_AT_ONCE = 50.0, 100.0
"""Requests, of all clients together; what leaves an interface is bounded there too (`sidecar/core/pinging.py`)."""
MAX_PINGS_OUT = 256
PONG_WAIT_S = 10.0
"""A ping is answered within this, or not at all: a round trip of 10 s is the longest that has to work."""
PAUSE_S = 0.001
"""After each piece of an answer, for the other threads."""
LOOK_S = 1.0
"""How often overdue connections are looked for."""
ACCEPT_PAUSE_S = 0.1
STOP_S = 1.0

REFUSALS = ("full", "user_full", "not_allowed", "bad_request", "too_often", "too_slow", "pongs_full")
"""The keys of `LocalServer.refused`."""

_SO_PEERGROUPS = 59
_MAX_GROUPS_BYTES = 1024
"""What Python asks the kernel for at most: 256 groups."""
_CREDENTIALS = struct.Struct("iII")


class LocalSource(Protocol):
    """What answers are made of; called on the server's thread."""

    def state(self) -> Iterator[tuple[str, Any]]:
        """Yield the parts of how everything is, each small."""

    def paths_to(self, peer: str, interface: str | None) -> list[PathId]:
        """Return the paths to a peer, over this interface alone if one is named."""

    def ping(self, path: PathId, number: int, size: int) -> None:
        """Send a ping; `LocalServer.on_pong` is told what became of it."""


class LocalSocketError(Exception):
    """The socket cannot be had; the text says why."""


@dataclass(slots=True)
class _PingRound:
    """A ping request under way."""

    request: int
    waiting: int
    ends_at: float


@dataclass(slots=True, eq=False)
class _Client:
    sock: socket.socket
    user: int
    heard_at: float
    """When it last made a whole request, read something or came (s)."""
    received: bytearray = field(default_factory=bytearray)
    unread: bytearray = field(default_factory=bytearray)
    answers: deque[Iterator[bytes]] = field(default_factory=deque)
    rounds: dict[int, _PingRound] = field(default_factory=dict)
    """By the request's id."""
    events: int = selectors.EVENT_READ
    closing: bool = False
    """Nothing more is read from it."""


class LocalServer:
    """Listens at `path` from `open` to `close`."""

    def __init__(self, path: Path, source: LocalSource) -> None:
        self.path = path
        self.refused: Counter[str] = Counter()
        """Connections and requests refused, by REFUSALS."""
        self._source = source
        self._listening: socket.socket | None = None
        self._inode = 0
        self._group: int | None = None
        self._clients: dict[int, _Client] = {}
        """By file descriptor."""
        self._selector = selectors.DefaultSelector()
        self._pongs: deque[Pong] = deque()
        self._bell = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._next_number = 0
        self._out: dict[int, tuple[_Client, int, PathId]] = {}
        """Pings that are out, by number: who asked, and in which request."""
        now = time.monotonic()
        self._accepts = TokenBucket(rate=ACCEPTS_PER_S, burst=ACCEPTS_AT_ONCE, now=now)
        self._states = TokenBucket(rate=STATES_PER_S, burst=STATES_AT_ONCE, now=now)
        self._ping_requests = TokenBucket(rate=PINGS_PER_S, burst=PINGS_AT_ONCE, now=now)
        self._accept_again_at: float | None = None
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="plr-local", daemon=True)

    def open(self) -> None:
        """Listen and serve; raises LocalSocketError."""
        try:
            self._listen()
        except OSError as error:
            raise LocalSocketError(error.strerror or str(error)) from error
        self._thread.start()

    def close(self) -> None:
        """Stop serving, and remove the socket."""
        self._stopping = True
        if self._thread.is_alive():
            self._ring()
            self._thread.join(STOP_S)
        if self._listening is not None:
            with contextlib.suppress(OSError):
                if self.path.stat().st_ino == self._inode:  # not one that took our place
                    self.path.unlink()

    def on_pong(self, pong: Pong) -> None:
        """What became of a ping; from any thread, which does not wait."""
        if len(self._pongs) >= 2 * MAX_PINGS_OUT:
            self.refused["pongs_full"] += 1
            return
        self._pongs.append(pong)
        self._ring()

    def _ring(self) -> None:
        with contextlib.suppress(OSError):
            os.eventfd_write(self._bell, 1)

    def _listen(self) -> None:
        if len(os.fsencode(self.path)) > 107:
            raise OSError(errno.ENAMETOOLONG, "the path of a socket has at most 107 bytes")
        self._remove_stale()
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
        try:
            # What the node in the file system will have: nobody else gets in before its group is set.
            os.fchmod(sock.fileno(), stat.S_IRUSR | stat.S_IWUSR)
            sock.bind(str(self.path))
            self._open_to_group()
            self._inode = self.path.stat().st_ino
            sock.listen(MAX_CONNECTIONS)
        except OSError:
            sock.close()
            raise
        self._listening = sock
        self._selector.register(sock, selectors.EVENT_READ)
        self._selector.register(self._bell, selectors.EVENT_READ)

    def _remove_stale(self) -> None:
        """A socket that nobody listens at was left by a run that was killed."""
        try:
            if not stat.S_ISSOCK(self.path.lstat().st_mode):
                raise OSError(errno.EEXIST, "something else than a socket is there")
        except FileNotFoundError:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK) as probe:
            answer = probe.connect_ex(str(self.path))
        if answer == errno.ECONNREFUSED:
            self.path.unlink(missing_ok=True)
        elif answer != errno.ENOENT:
            raise OSError(errno.EADDRINUSE, "another sidecar listens there: set local_socket in one of them")

    def _open_to_group(self) -> None:
        try:
            group = grp.getgrnam(GROUP).gr_gid
        except KeyError:
            return
        if self.path.stat().st_gid != group:
            if os.geteuid() != 0 and group not in os.getgroups():
                return
            os.chown(self.path, -1, group)
        self.path.chmod(stat.S_IRUSR | stat.S_IWUSR | stat.S_IRGRP | stat.S_IWGRP)
        self._group = group

    # Runs on the thread ------------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while not self._stopping:
                try:
                    self._turn()
                except Exception:
                    log.exception("internal error; the local socket goes on")
                    time.sleep(ACCEPT_PAUSE_S)
        finally:
            for client in list(self._clients.values()):
                self._drop(client)
            self._selector.close()
            if self._listening is not None:
                self._listening.close()

    def _turn(self) -> None:
        for key, events in self._selector.select(self._wait_s()):
            if key.fileobj is self._listening:
                self._accept()
            elif key.fd == self._bell:
                os.eventfd_read(self._bell)
            else:
                client = self._clients.get(key.fd)
                if client is not None:
                    self._serve(client, events)
        self._deliver_pongs()
        now = time.monotonic()
        if self._accept_again_at is not None and now >= self._accept_again_at and self._listening is not None:
            self._accept_again_at = None
            self._selector.register(self._listening, selectors.EVENT_READ)
        self._look_for_overdue(now)

    def _wait_s(self) -> float:
        if self._accept_again_at is not None:
            return ACCEPT_PAUSE_S
        return LOOK_S if self._clients else 60.0

    def _accept(self) -> None:
        assert self._listening is not None
        now = time.monotonic()
        if not self._accepts.take(now):
            # They wait in the kernel, which holds few.
            self._selector.unregister(self._listening)
            self._accept_again_at = now + ACCEPT_PAUSE_S
            return
        try:
            sock, _ = self._listening.accept()
        except OSError:
            return
        sock.setblocking(False)
        refusal = self._refusal(sock)
        if refusal is not None:
            why, text = refusal
            self.refused[why] += 1
            with contextlib.suppress(OSError):
                sock.send(encode_error(None, text))
            sock.close()
            return
        client = _Client(sock, _user(sock), now)
        self._clients[sock.fileno()] = client
        self._selector.register(sock, selectors.EVENT_READ)

    def _refusal(self, sock: socket.socket) -> tuple[str, str] | None:
        user = _user(sock)
        # The socket's mode says the same; a folder that was opened wider, or a descriptor passed on, does not undo it.
        if user not in (0, os.geteuid()) and (self._group is None or self._group not in _groups(sock)):
            return "not_allowed", f"only root and members of the group {GROUP} may ask"
        if len(self._clients) >= MAX_CONNECTIONS:
            return "full", "too many ask at once: try again"
        if user != 0 and sum(client.user == user for client in self._clients.values()) >= MAX_OF_A_USER:
            return "user_full", "too many of this user ask at once: try again"
        return None

    def _serve(self, client: _Client, events: int) -> None:
        try:
            if events & selectors.EVENT_READ:
                self._read(client)
            self._write(client)
        except OSError:
            self._drop(client)
            return
        except Exception:
            log.exception("internal error; a client of the local socket is let go")
            self._drop(client)
            return
        self._follow(client)

    def _read(self, client: _Client) -> None:
        try:
            data = client.sock.recv(MAX_REQUEST_BYTES)
        except BlockingIOError:  # the event was of another connection, which had its number before
            return
        if not data:
            raise ConnectionResetError
        client.received += data
        while not client.closing and (end := client.received.find(b"\n")) >= 0:
            line = bytes(client.received[:end])
            del client.received[: end + 1]
            client.heard_at = time.monotonic()
            self._take(client, line)
        if len(client.received) > MAX_REQUEST_BYTES:
            self._refuse_for_good(client, f"a request is a line of at most {MAX_REQUEST_BYTES} bytes")

    def _take(self, client: _Client, line: bytes) -> None:
        try:
            request = decode_request(line)
        except DecodeError as error:
            self._refuse_for_good(client, str(error))
            return
        now = time.monotonic()
        if len(client.answers) + len(client.rounds) >= MAX_REQUESTS or request.id in client.rounds:
            self._too_often(client, request.id)
        elif isinstance(request, StateRequest):
            if self._states.take(now):
                client.answers.append(self._state(request.id))
            else:
                self._too_often(client, request.id)
        elif self._ping_requests.take(now):
            self._ping(client, request, now)
        else:
            self._too_often(client, request.id)

    def _too_often(self, client: _Client, request: int) -> None:
        self.refused["too_often"] += 1
        client.unread += encode_error(request, "too many requests: wait a second")

    def _refuse_for_good(self, client: _Client, text: str) -> None:
        self.refused["bad_request"] += 1
        client.received.clear()
        client.unread += encode_error(None, text)
        client.closing = True

    def _state(self, request: int) -> Iterator[bytes]:
        for part, value in self._source.state():
            yield encode_part(request, part, value)
        yield encode_end(request)

    def _ping(self, client: _Client, request: PingRequest, now: float) -> None:
        paths = self._source.paths_to(request.peer, request.interface)
        if not paths:
            over = "" if request.interface is None else f" over {request.interface}"
            client.unread += encode_error(
                request.id, f"there is no path to {request.peer}{over}: plr doctor names the peers"
            )
            return
        if len(self._out) + len(paths) > MAX_PINGS_OUT:
            self._too_often(client, request.id)
            return
        client.rounds[request.id] = _PingRound(request.id, len(paths), now + PONG_WAIT_S)
        pinged = [{"interface": path.interface, "remote": path.remote} for path in paths]
        client.unread += encode_part(request.id, "pinged", pinged)
        for path in paths:
            self._next_number += 1
            self._out[self._next_number] = client, request.id, path
            self._source.ping(path, self._next_number, request.size)

    def _deliver_pongs(self) -> None:
        while self._pongs:
            pong = self._pongs.popleft()
            client, request, path = self._out.pop(pong.number, (None, 0, pong.path))
            if client is None:
                continue
            value = {"interface": path.interface, "remote": path.remote, "rtt_s": pong.rtt_s, "problem": pong.problem}
            client.unread += encode_part(request, "pong", value)
            round_ = client.rounds.get(request)
            if round_ is not None:
                round_.waiting -= 1
                if not round_.waiting:
                    del client.rounds[request]
                    client.unread += encode_end(request)
            self._serve(client, 0)

    def _write(self, client: _Client) -> None:
        while True:
            if client.unread:
                try:
                    sent = client.sock.send(client.unread)
                except BlockingIOError:
                    return
                client.heard_at = time.monotonic()
                del client.unread[:sent]
                if client.unread:
                    return
            if not client.answers:
                return
            piece = next(client.answers[0], None)
            if piece is None:
                client.answers.popleft()
            else:
                client.unread += piece
                time.sleep(PAUSE_S)

    def _follow(self, client: _Client) -> None:
        """Wait for what the client may do next."""
        if client.closing and not client.unread:
            self._drop(client)
            return
        # Who does not read is not read from.
        reading = not client.closing and len(client.unread) < MAX_UNREAD_BYTES
        events = (selectors.EVENT_READ if reading else 0) | (selectors.EVENT_WRITE if client.unread else 0)
        if events and events != client.events:
            self._selector.modify(client.sock, events)
            client.events = events

    def _look_for_overdue(self, now: float) -> None:
        for client in list(self._clients.values()):
            for request, round_ in list(client.rounds.items()):
                if now >= round_.ends_at:
                    del client.rounds[request]
                    self._forget_pings(client, request)
                    client.unread += encode_end(request)
                    self._serve(client, 0)
            stuck = client.unread or client.received
            if not client.rounds and now >= client.heard_at + (PATIENCE_S if stuck else IDLE_S):
                if stuck:
                    self.refused["too_slow"] += 1
                self._drop(client)

    def _forget_pings(self, client: _Client, request: int | None = None) -> None:
        for number, (one, its, _) in list(self._out.items()):
            if one is client and request in (None, its):
                del self._out[number]

    def _drop(self, client: _Client) -> None:
        if self._clients.pop(client.sock.fileno(), None) is None:
            return
        self._forget_pings(client)
        self._selector.unregister(client.sock)
        client.sock.close()


def _user(sock: socket.socket) -> int:
    credentials = sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    return int(_CREDENTIALS.unpack(credentials)[1])


def _groups(sock: socket.socket) -> set[int]:
    """The groups of who connected, as they were then."""
    own = int(_CREDENTIALS.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))[2])
    try:
        packed = sock.getsockopt(socket.SOL_SOCKET, _SO_PEERGROUPS, _MAX_GROUPS_BYTES)
    except OSError:  # before Linux 4.13, or more groups than anybody has
        return {own}
    return {own, *(group for (group,) in struct.iter_unpack("I", packed))}
