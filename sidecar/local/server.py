"""Serves a sidecar's local socket: few clients at once, none for long, any of them; the data plane never waits.

There is one thread, and it holds no lock while it serves a client. A client's cost is bounded: connections, the bytes
of a request, unread output, requests a second, outstanding pings. Each user has a share of these, and root (with the
sidecar's own user: the owner) has one that the members of the group do not touch. An answer is built piece by piece, as
the client reads it, alternating with those of others and with a pause after each piece, so that thousands of paths do
not keep the interpreter from other threads.
"""

from __future__ import annotations

import contextlib
import grp
import logging
import os
import select
import selectors
import threading
import time
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from plr.protos.base.errors import DecodeError
from plr.sidecar.core.link.pinging import Pong
from plr.sidecar.local.entrance import Entrance, SocketLock, for_group
from plr.sidecar.local.peer import groups_of, user_of
from plr.sidecar.local.protocol import (
    MAX_REQUEST_LINE_BYTES,
    MAX_REQUESTS_OF_CONNECTION,
    PingRequest,
    StateRequest,
    decode_request,
    encode_end,
    encode_error,
    encode_part,
)
from plr.sidecar.local.shares import Rate, Rates, UserShares

if TYPE_CHECKING:
    import socket
    from collections.abc import Iterator
    from pathlib import Path

    from plr.sidecar.core.base.values import PathId

log = logging.getLogger(__name__)

GROUP = "plr"
"""Group whose members may ask, besides root and the sidecar's own user."""
MAX_OWN = 8
"""Most connections of root and the sidecar's own user."""
MAX_MEMBER_CONNECTIONS = 16
"""Most connections of all others together ..."""
MAX_OF_A_USER = 4
"""... and of each of them."""
IDLE_S = 30.0
"""A connection that asks nothing for this long is closed; ..."""
PATIENCE_S = 5.0
"""... one that has begun a request, or has not read an answer, after this time."""
MAX_UNREAD_BYTES = 65_536
"""Output that a client may leave unread; beyond that its requests are not read."""
STATES = Rates(owner=Rate(4.0, 8.0), members=Rate(2.0, 8.0), member=Rate(1.0, 4.0))
PING_REQUESTS = Rates(owner=Rate(50.0, 100.0), members=Rate(40.0, 80.0), member=Rate(20.0, 40.0))
PINGS = Rates(owner=Rate(50.0, 100.0), members=Rate(10.0, 30.0), member=Rate(5.0, 15.0))
"""Pings over each interface, which sends few (`sidecar/core/link/pinging.py`): members leave half of them to root."""
MAX_PINGED_INTERFACES = 64
"""Interfaces whose requested pings are remembered."""
MAX_REQUESTED_PINGS = 256
MAX_OUT_OF_MEMBERS, MAX_OUT_OF_A_USER = 192, 64
PONG_WAIT_S = 10.0
"""Time within which a ping is answered, or not at all: a round trip of 10 s is the longest that has to work."""
REST_S = 0.2
"""Time for which a client that asks too often is not read from: refusing takes time as well."""
PAUSE_S = 0.001
"""Pause after each piece of an answer, for the other threads."""
LOOK_S = 1.0
"""Interval of the search for overdue connections."""
ERROR_PAUSE_S = 0.1
STOP_S = 1.0

REFUSALS = ("full", "user_full", "not_allowed", "bad_request", "too_often", "too_slow", "pongs_full")
"""The keys of `LocalSocketServer.refused`."""

_TOO_MANY_PINGS = "too many pings of users other than root: wait a second"


class LocalSource(Protocol):
    """The source of the answers; called on the server's thread."""

    def state(self) -> Iterator[tuple[str, Any]]:
        """Yield the parts of the sidecar's state, each small."""

    def paths_to(self, peer: str, interface: str | None) -> list[PathId]:
        """Return the paths to a peer, only those over `interface` if it is given."""

    def ping(self, path: PathId, number: int, size: int) -> None:
        """Send a ping; `LocalSocketServer.on_pong` gets the result."""


class LocalSocketError(Exception):
    """The socket cannot be opened; the text says why."""


@dataclass(slots=True)
class _PingRound:
    """A ping request under way."""

    request: int
    waiting: int
    ends_at: float


@dataclass(slots=True, eq=False)
class _Client:
    sock: socket.socket
    user: int | None
    """None: the owner."""
    heard_at: float
    """When it last made a whole request, read something or came (s)."""
    received: bytearray = field(default_factory=bytearray)
    unread: bytearray = field(default_factory=bytearray)
    answers: deque[Iterator[bytes]] = field(default_factory=deque)
    rounds: dict[int, _PingRound] = field(default_factory=dict)
    """Ping requests under way, by id."""
    events: int = selectors.EVENT_READ
    """Selector events it is watched for; 0: none."""
    rests_until: float = 0.0
    """Time until which nothing is read from it; 0: it does not rest."""
    ended: bool = False
    """It sends nothing more, but may still read."""
    closing: bool = False
    """No more requests are taken from it."""


class LocalSocketServer:
    """Listens at `path` from `open` to `close`."""

    def __init__(self, path: Path, source: LocalSource) -> None:
        self.path = path
        self.refused: Counter[str] = Counter()
        """Connections and requests refused, by REFUSALS."""
        self._source = source
        self._lock = SocketLock(path)
        self._entrances: tuple[Entrance, ...] = ()
        self._group: int | None = None
        self._clients: dict[int, _Client] = {}
        """Clients by file descriptor."""
        self._selector = selectors.DefaultSelector()
        self._pongs: deque[Pong] = deque()
        self._bell = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._next_number = 0
        self._out: dict[int, tuple[_Client, int, PathId]] = {}
        """Outstanding pings by number: (client, request's id, path)."""
        now = time.monotonic()
        self._states = UserShares(STATES, now)
        self._ping_requests = UserShares(PING_REQUESTS, now)
        self._pings: dict[str, UserShares] = {}
        """Shares of pings by interface."""
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="plr-local", daemon=True)

    def open(self) -> None:
        """Listen and serve; raises LocalSocketError."""
        try:
            self._listen()
        except OSError as error:
            self._stop_listening()
            raise LocalSocketError(error.strerror or str(error)) from error
        self._thread.start()

    def close(self) -> None:
        """Stop serving, and remove the sockets."""
        self._stopping = True
        if self._thread.is_alive():
            self._ring()
            self._thread.join(STOP_S)
        self._stop_listening()

    def on_pong(self, pong: Pong) -> None:
        """Take the result of a ping; from any thread, which does not wait."""
        if len(self._pongs) >= 2 * MAX_REQUESTED_PINGS:
            self.refused["pongs_full"] += 1
            return
        self._pongs.append(pong)
        self._ring()

    def _ring(self) -> None:
        with contextlib.suppress(OSError):
            os.eventfd_write(self._bell, 1)

    def _listen(self) -> None:
        self._lock.take()
        now = time.monotonic()
        self._group = _group()
        self._open(Entrance(self.path), now)
        if self._group is not None:
            try:
                self._open(Entrance(for_group(self.path), self._group), now)
            except OSError as error:
                log.warning("%s: members of %s cannot ask: %s", for_group(self.path), GROUP, error.strerror or error)
        self._selector.register(self._bell, selectors.EVENT_READ)

    def _open(self, entrance: Entrance, now: float) -> None:
        entrance.open(now)
        assert entrance.sock is not None
        self._entrances += (entrance,)
        self._selector.register(entrance.sock, selectors.EVENT_READ, entrance)

    def _stop_listening(self) -> None:
        for entrance in self._entrances:
            entrance.close()
        self._lock.release()

    # Runs on the thread ------------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while not self._stopping:
                try:
                    self._turn()
                except Exception:
                    log.exception("internal error; the local socket continues")
                    time.sleep(ERROR_PAUSE_S)
        finally:
            for client in list(self._clients.values()):
                self._drop(client)
            self._selector.close()

    def _turn(self) -> None:
        for key, events in self._selector.select(self._wait_s()):
            if isinstance(key.data, Entrance):
                self._accept(key.data)
            elif key.fd == self._bell:
                os.eventfd_read(self._bell)
            else:
                client = self._clients.get(key.fd)
                if client is not None:
                    self._serve(client, events)
        self._deliver_pongs()
        now = time.monotonic()
        for entrance in self._entrances:
            if entrance.sock is not None and entrance.again_at is not None and now >= entrance.again_at:
                entrance.again_at = None
                self._selector.register(entrance.sock, selectors.EVENT_READ, entrance)
        self._look_for_overdue(now)

    def _wait_s(self) -> float:
        paused = [entrance.again_at for entrance in self._entrances if entrance.again_at is not None]
        if paused:
            return max(0.0, min(paused) - time.monotonic())
        if not self._clients:
            return 60.0
        return min(LOOK_S, REST_S) if any(client.rests_until for client in self._clients.values()) else LOOK_S

    def _accept(self, entrance: Entrance) -> None:
        now = time.monotonic()
        sock = entrance.accept(now)
        if sock is None:
            if entrance.again_at is not None and entrance.sock is not None:
                # New connections wait in the kernel, which holds few.
                self._selector.unregister(entrance.sock)
            return
        user = user_of(sock)
        owner = user in (0, os.geteuid())
        refusal = self._refusal(sock, None if owner else user)
        if refusal is not None:
            why, text = refusal
            self.refused[why] += 1
            with contextlib.suppress(OSError):
                sock.send(encode_error(None, text, busy=why != "not_allowed"))
            sock.close()
            return
        self._clients[sock.fileno()] = _Client(sock, None if owner else user, now)
        self._selector.register(sock, selectors.EVENT_READ)

    def _refusal(self, sock: socket.socket, user: int | None) -> tuple[str, str] | None:
        others = [client.user for client in self._clients.values()]
        if user is None:
            return ("full", "too many clients ask at once: try again") if others.count(None) >= MAX_OWN else None
        # The socket's mode demands the same; a folder opened wider, or a descriptor passed on, does not undo this.
        if self._group is None or self._group not in groups_of(sock):
            return "not_allowed", f"only root and members of the group {GROUP} may ask"
        if others.count(user) >= MAX_OF_A_USER:
            return "user_full", "too many clients of this user ask at once: try again"
        if len(others) - others.count(None) >= MAX_MEMBER_CONNECTIONS:
            return "full", "too many clients ask at once: try again"
        return None

    def _serve(self, client: _Client, events: int) -> None:
        try:
            if events & selectors.EVENT_READ:
                self._read(client)
            self._take_lines(client)
            self._write(client)
        except OSError:
            self._drop(client)
            return
        except Exception:
            log.exception("internal error; a client of the local socket is disconnected")
            self._drop(client)
            return
        self._follow(client)

    def _read(self, client: _Client) -> None:
        try:
            data = client.sock.recv(MAX_REQUEST_LINE_BYTES)
        except BlockingIOError:  # the event belonged to an earlier connection with the same number
            return
        if not data and _is_gone(client.sock):
            raise ConnectionResetError
        # Otherwise it has shut down its side (as `nc -N` does), and may still read what it has asked for.
        client.ended = not data
        client.received += data

    def _take_lines(self, client: _Client) -> None:
        while not client.closing and not client.rests_until and (end := client.received.find(b"\n")) >= 0:
            line = bytes(client.received[:end])
            del client.received[: end + 1]
            client.heard_at = time.monotonic()
            self._take(client, line)
        if client.closing or client.rests_until:
            return
        if len(client.received) > MAX_REQUEST_LINE_BYTES:
            self._refuse_and_close(client, f"a request is a line of at most {MAX_REQUEST_LINE_BYTES} bytes")
        elif client.ended:
            client.closing = True
            if client.received:
                # The last line needs no newline.
                line = bytes(client.received)
                client.received.clear()
                self._take(client, line)

    def _take(self, client: _Client, line: bytes) -> None:
        try:
            request = decode_request(line)
        except DecodeError as error:
            self._refuse_and_close(client, str(error))
            return
        now = time.monotonic()
        if len(client.answers) + len(client.rounds) >= MAX_REQUESTS_OF_CONNECTION or request.id in client.rounds:
            self._too_often(client, request.id)
        elif isinstance(request, StateRequest):
            if self._states.take(client.user, now):
                client.answers.append(self._state(request.id))
            else:
                self._too_often(client, request.id)
        elif self._ping_requests.take(client.user, now):
            self._ping(client, request, now)
        else:
            self._too_often(client, request.id)

    def _too_often(self, client: _Client, request: int) -> None:
        self.refused["too_often"] += 1
        client.unread += encode_error(request, "too many requests: wait a second", busy=True)
        client.rests_until = time.monotonic() + REST_S

    def _refuse_and_close(self, client: _Client, text: str) -> None:
        self.refused["bad_request"] += 1
        client.received.clear()
        client.answers.clear()
        client.rounds.clear()
        self._forget_pings(client)
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
        if not self._may_be_out(client.user, len(paths)):
            self._too_often(client, request.id)
            return
        client.rounds[request.id] = _PingRound(request.id, len(paths), now + PONG_WAIT_S)
        pinged = [{"interface": path.interface, "remote": path.remote} for path in paths]
        client.unread += encode_part(request.id, "pinged", pinged)
        for path in paths:
            self._next_number += 1
            self._out[self._next_number] = client, request.id, path
            if self._shares_of(path.interface, now).take(client.user, now):
                self._source.ping(path, self._next_number, request.size)
            else:
                self.refused["too_often"] += 1
                self._pongs.append(Pong(self._next_number, path, problem=_TOO_MANY_PINGS))

    def _may_be_out(self, user: int | None, more: int) -> bool:
        users = [client.user for client, _, _ in self._out.values()]
        if len(users) + more > MAX_REQUESTED_PINGS:
            return False
        return user is None or (
            users.count(user) + more <= MAX_OUT_OF_A_USER
            and len(users) - users.count(None) + more <= MAX_OUT_OF_MEMBERS
        )

    def _shares_of(self, interface: str, now: float) -> UserShares:
        shares = self._pings.get(interface)
        if shares is None:
            if len(self._pings) >= MAX_PINGED_INTERFACES:
                del self._pings[next(iter(self._pings))]
            shares = self._pings[interface] = UserShares(PINGS, now)
        return shares

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
        if client.unread:
            try:
                sent = client.sock.send(client.unread)
            except BlockingIOError:
                return
            client.heard_at = time.monotonic()
            del client.unread[:sent]
        if client.unread or not client.answers:
            return
        # Only one piece: pieces for other users and for root come in between.
        piece = next(client.answers[0], None)
        if piece is None:
            client.answers.popleft()
        else:
            client.unread += piece
            time.sleep(PAUSE_S)

    def _follow(self, client: _Client) -> None:
        """Watch the client for what it may do next, or drop it when it is done."""
        busy = bool(client.unread or client.answers)
        if client.closing and not busy and not client.rounds:
            self._drop(client)
            return
        # Requests of a client that does not read its answers are not read.
        silent = client.closing or client.ended or client.rests_until
        reading = not silent and len(client.unread) < MAX_UNREAD_BYTES
        events = (selectors.EVENT_READ if reading else 0) | (selectors.EVENT_WRITE if busy else 0)
        if events == client.events:
            return
        if not events:
            self._selector.unregister(client.sock)
        elif not client.events:
            self._selector.register(client.sock, events)
        else:
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
            if client.sock.fileno() < 0:
                continue
            if not client.events and _is_gone(client.sock):
                self._drop(client)
                continue
            if client.rests_until and now >= client.rests_until:
                client.rests_until = 0.0
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
        if client.events:
            self._selector.unregister(client.sock)
        client.sock.close()


def _is_gone(sock: socket.socket) -> bool:
    """Return whether the other end is closed, and not only its direction to us."""
    poll = select.poll()
    poll.register(sock, 0)
    return bool(poll.poll(0))


def _group() -> int | None:
    """Return the group whose members may ask; None if there is none, or the sidecar may not give it a socket."""
    try:
        group = grp.getgrnam(GROUP).gr_gid
    except KeyError:
        return None
    return group if os.geteuid() == 0 or group in {os.getegid(), *os.getgroups()} else None
