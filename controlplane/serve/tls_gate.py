"""Guards the only way to the gRPC server from outside: mutual TLS 1.3 in front of a Unix socket of our own.

    sidecar ══ TLS ══▶ gate ── unix socket in a folder of mode 0700 ──▶ gRPC server

gRPC for Python reports neither why a handshake failed nor which handshakes are pending. It cannot refuse TLS 1.2, and
gives no access to a connection whose certificate is revoked. The gate does all of that: it counts every refusal by its
reason, bounds the half-open connections, and ends connections. The gRPC server knows a connection by the name that the
gate bound its end of the Unix socket to; the gate knows whose certificate stands behind that name.
"""

from __future__ import annotations

import asyncio
import asyncio.sslproto
import contextlib
import ipaddress
import logging
import math
import secrets
import select
import socket
import ssl
from collections import OrderedDict
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

from plr.controlplane.core.overload.admission import Admission
from plr.controlplane.serve.earliest_end import EarliestEnd
from plr.controlplane.serve.gate_pipe import PipeEnd
from plr.controlplane.serve.half_open import HalfOpen
from plr.controlplane.serve.handshakes import server_context, why_failed
from plr.protos.base.token_bucket import TokenBucket
from plr.protos.model.members import MAX_SIDECARS
from plr.protos.trust.identity import CertificateError, IdentityRole

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from plr.protos.model.ids import NodeName
    from plr.protos.program.tls_files import TlsFiles
    from plr.protos.trust.clock_floor import ClockFloor
    from plr.protos.trust.identity import Identity, Trust

log = logging.getLogger(__name__)

HANDSHAKE_TIMEOUT_S = 5.0
"""Two round trips over a bad cellular link take 1 to 2 s; a sidecar gives up after 5 s."""

MAX_HANDSHAKES = 512
"""Concurrent TLS handshakes; a further one ends the oldest, so that a client that holds all of them has to hurry."""

MAX_HANDSHAKES_PER_SOURCE = 256
"""The same from one address (IPv6: one /64), which may be a NAT with a fleet behind it. A further one ends the oldest
of the same address."""

TURN_TIMEOUT_S = 40.0
"""Longest wait for a turn to begin a handshake: as long as a sidecar of a large fleet waits."""

MAX_ON_THE_WAY = 64
"""Concurrent connections between the start of their handshakes and their registration: half a second of work, behind
which any further one would wait. Enough for a hundred a second from networks as slow as cellular ones."""

ON_THE_WAY_S = 1.0
"""How long one counts as such without a certificate: three round trips over a slow network. A stranger that takes
longer keeps nobody waiting."""

MAX_WAITING_CONNECTIONS = MAX_SIDECARS + 256
"""Connections that wait for their turn: the largest fleet. They have no TLS state yet; each costs a descriptor and a
few kB."""

LOOK_EVERY_S = 0.1
"""Interval between checks for clients that have stopped waiting."""

ACCEPTED_AT_ONCE = 16
"""Connections accepted in one turn of the loop."""

MAX_SILENT = 2048
"""Concurrent connections that have sent nothing yet."""

MAX_SILENT_PER_SOURCE = 1024
"""The same from one address."""

MAX_TLS_CONNECTIONS = 2 * MAX_SIDECARS + 64
"""Concurrent connections: one for each sidecar that may register, its replacement, and some for operators."""

MAX_CONNECTIONS_PER_NAME = 8
"""A further one ends the oldest: after a change of networks that one is dead, but its end is not noticed yet."""

LAST_WORDS_S = 0.5
"""Time between the end of a certificate and that of its connections, for gRPC to say why."""

ACCEPT_PAUSE_S = 0.1
"""Pause after the system refused to accept: it is out of descriptors, and will be for a moment."""

READ_SIZE = 16 * 1024
"""Bytes in one read: a TLS record, and more than any message of a small fleet."""

asyncio.sslproto.SSLProtocol.max_size = READ_SIZE
"""The default is 256 kB. There is no other way to set it."""

_READ = bytearray(READ_SIZE)
"""Read buffer of all TLS connections. asyncio gives each its own, although the content goes on to OpenSSL before the
next connection is read."""

TOO_MANY_HANDSHAKES = "too_many_handshakes"
TOO_MANY_CONNECTIONS = "too_many_connections"
GAVE_UP = "gave_up"
"""Reason of refusal: the client left while it waited for its turn."""

TELL_AGAIN_S = 60.0
"""Interval before a member refused again for the same reason is logged again."""

MAX_LOGGED_REFUSALS = 4096
"""Pairs of member and reason kept for that; the one logged longest ago is dropped."""

_LOG_LINES_PER_S = 1.0
_LOG_BURST = 20.0


_REGISTERS = frozenset({IdentityRole.ROBOT, IdentityRole.CLOUD})


@dataclass(frozen=True, slots=True)
class Caller:
    """The certificate's owner behind a connection; `refusal` says why it is not, or no longer, believed."""

    identity: Identity
    certificate: bytes = field(repr=False)
    refusal: CertificateError | None = None


@dataclass(slots=True, eq=False)
class _Connection:
    caller: Caller
    outside: PipeEnd
    inside: PipeEnd
    admitted: asyncio.Task[None]
    """The task that admitted it."""


class TlsGate:
    """Accepts connections for the gRPC servers at the Unix sockets `upstreams`, in rotation; for one event loop.

    `on_refused` receives the reason of every connection that is refused or ended. Certificates are checked by `clock`.
    """

    def __init__(
        self, files: TlsFiles, upstreams: Sequence[str], on_refused: Callable[[str], None], clock: ClockFloor
    ) -> None:
        self._clock = clock
        self._trust: Trust = files.trust
        self._context = server_context(files)
        self._upstreams = upstreams
        self._on_refused = on_refused
        self._loop = asyncio.get_running_loop()
        self._socket: socket.socket | None = None
        self._working: list[asyncio.Task[None]] = []
        self._unread: set[socket.socket] = set()
        """Sockets that asyncio has not taken over yet."""
        self._silent = HalfOpen(MAX_SILENT, MAX_SILENT_PER_SOURCE)
        self._handshakes = HalfOpen(MAX_HANDSHAKES, MAX_HANDSHAKES_PER_SOURCE)
        self._admission: Admission[asyncio.Task[None]] = Admission(
            most_waiting=MAX_WAITING_CONNECTIONS,
            most_on_the_way=MAX_ON_THE_WAY,
            stranger_s=ON_THE_WAY_S,
            member_s=HANDSHAKE_TIMEOUT_S,
        )
        self._turns: dict[asyncio.Task[None], asyncio.Future[None]] = {}
        """The turns of the connections that wait."""
        self._waiting: dict[int, asyncio.Task[None]] = {}
        """The waiting tasks by their sockets' descriptors."""
        self._ends = select.poll()
        """Tells which of these clients have left."""
        self._room = asyncio.Event()
        """Set when a connection begins to wait, or is done."""
        self._connections: OrderedDict[str, _Connection] = OrderedDict()
        self._of_name: dict[NodeName, OrderedDict[str, None]] = {}
        """Connections by the certificate's name, oldest first."""
        self._earliest_end = EarliestEnd()
        # A name is never reused, in this process or another on this host: a stale one must not become somebody else's.
        self._prefix = f"plr-{secrets.token_hex(8)}"
        self._count = 0
        self._told: OrderedDict[tuple[NodeName, str], float] = OrderedDict()
        """When each refused member was last logged, by name and reason."""
        self.on_member_refused: Callable[[NodeName, CertificateError], None] = lambda name, error: None
        """Called, as seldom as the log, with the member whose certificate is not believed, and why."""
        self._log_lines = TokenBucket(rate=_LOG_LINES_PER_S, burst=_LOG_BURST, now=self._loop.time())

    # ── for the server ──

    def listen(self, host: str, port: int) -> int:
        """Accept connections from now on and return the port; raises OSError if the address is not available."""
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        dual = family == socket.AF_INET6 and host == "::" and socket.has_dualstack_ipv6()
        self._socket = socket.create_server(
            (host, port), family=family, backlog=MAX_WAITING_CONNECTIONS, dualstack_ipv6=dual
        )
        self._socket.setblocking(False)
        self._working = [
            self._loop.create_task(self._accept(self._socket)),
            self._loop.create_task(self._give_turns()),
        ]
        taken: int = self._socket.getsockname()[1]
        return taken

    def caller(self, peer: str) -> Caller | None:
        """Return who is behind the connection that gRPC calls `peer`; None if there is none (any more)."""
        connection = self._connections.get(peer)
        return None if connection is None else connection.caller

    def address(self, peer: str) -> str:
        """Return where the connection that gRPC calls `peer` comes from; that name itself if it has ended."""
        connection = self._connections.get(peer)
        known = None if connection is None else connection.outside.transport.get_extra_info("peername")
        return str(known[0]) if known else peer

    def is_served(self, peer: str) -> None:
        """Note that this connection is registered or refused: the next one may have its turn."""
        connection = self._connections.get(peer)
        if connection is not None:
            self._is_through(connection.admitted, connection.caller.identity.name)

    def has_unread(self, name: NodeName, since: float) -> bool:
        """Return whether a member has sent something, over any connection, that nobody can have read by `since`
        (monotonic seconds): bytes that wait in the kernel, or were passed on to gRPC later than that."""
        return any(
            connection.outside.received_at > since or connection.outside.unread()
            for connection in map(self._connections.__getitem__, self._of_name.get(name, ()))
        )

    def use(self, files: TlsFiles) -> None:
        """Use these files from now on; open connections stay open until `review`.

        Raises:
            ssl.SSLError: OpenSSL refuses the files; the previous ones stay in use.
        """
        self._context = server_context(files)
        self._trust = files.trust

    def serials(self) -> list[tuple[NodeName, int]]:
        """Return the members whose certificates stand behind the connections, with their serial numbers."""
        return [
            (connection.caller.identity.name, connection.caller.identity.serial)
            for connection in self._connections.values()
        ]

    def ended(self, now_wall: float) -> list[NodeName]:
        """Return the members whose certificates have expired."""
        in_use = (
            (connection.caller.identity.name, connection.caller.identity.not_after)
            for connection in self._connections.values()
            if connection.caller.refusal is None
        )
        return self._earliest_end.ended(in_use, now_wall)

    def review(self, name: NodeName) -> None:
        """End a member's connections whose certificates are no longer believed."""
        for peer in list(self._of_name.get(name, ())):
            self._review(self._connections[peer])

    async def close(self) -> None:
        """End everything."""
        tasks = [*self._working, *self._silent.tasks(), *self._turns, *self._handshakes.tasks()]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        if self._socket is not None:
            self._socket.close()
        for connection in list(self._connections.values()):
            connection.outside.abort()
            connection.inside.abort()

    # ── accepting ──

    async def _accept(self, listening: socket.socket) -> None:
        count = 0
        while True:
            try:
                accepted, address = await self._loop.sock_accept(listening)
            except OSError as error:
                log.warning("cannot accept a connection: %s", error)
                await asyncio.sleep(ACCEPT_PAUSE_S)
                continue
            source = _source(address[0])
            task = self._loop.create_task(self._greet(accepted, address[0], source))
            self._note(self._silent, task, source)
            task.add_done_callback(self._silent.remove)
            task.add_done_callback(self._handshakes.remove)
            self._unread.add(accepted)
            task.add_done_callback(partial(self._close_unread, accepted))
            count += 1
            if count % ACCEPTED_AT_ONCE == 0:
                await asyncio.sleep(0)

    async def _greet(self, accepted: socket.socket, address: str, source: str) -> None:
        """Wait for the client's first bytes: a silent one must not keep others from their handshakes.

        Then wait for its turn, and admit it.
        """
        accepted.setblocking(False)
        task = asyncio.current_task()
        assert task is not None
        if not _has_spoken(accepted):
            try:
                async with asyncio.timeout(HANDSHAKE_TIMEOUT_S):
                    await _readable(self._loop, accepted)
            except TimeoutError as error:
                self._refused(address, *why_failed(error))
                return
        self._silent.remove(task)
        try:
            async with asyncio.timeout(TURN_TIMEOUT_S):
                await self._turn(task, accepted, source)
        except TimeoutError:
            self._on_refused(TOO_MANY_HANDSHAKES)
            return
        except ConnectionError:
            self._on_refused(GAVE_UP)
            return
        self._note(self._handshakes, task, source)
        self._unread.discard(accepted)
        through = False
        try:
            through = await self._admit(accepted, address, task)
        finally:
            if not through:
                self._is_through(task)

    async def _turn(self, task: asyncio.Task[None], accepted: socket.socket, source: str) -> None:
        """Wait for the connection's turn; raises ConnectionError as soon as the client leaves."""
        turn = self._turns[task] = self._loop.create_future()
        self._waiting[accepted.fileno()] = task
        self._ends.register(accepted, select.POLLRDHUP)
        pushed_out = self._admission.wait(task, source)
        if pushed_out is not None:
            self._on_refused(TOO_MANY_HANDSHAKES)
            pushed_out.cancel()
        self._room.set()
        try:
            await turn
        except BaseException:
            # The turn may just have been granted.
            self._admission.leave(task)
            self._is_through(task)
            raise
        finally:
            self._ends.unregister(accepted)
            del self._turns[task], self._waiting[accepted.fileno()]

    async def _give_turns(self) -> None:
        """Grant one in each turn of the loop, so that other work, such as the messages of admitted members, runs
        between two."""
        looked_at = self._loop.time()
        while True:
            now = self._loop.time()
            if now >= looked_at + LOOK_EVERY_S:
                looked_at = now
                self._drop_gone()
            task = self._admission.next(now)
            if task is not None:
                turn = self._turns[task]
                if not turn.done():
                    turn.set_result(None)
                await asyncio.sleep(0)
                continue
            self._room.clear()
            next_at = self._admission.next_at()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout_at(None if next_at is None else min(next_at, looked_at + LOOK_EVERY_S)):
                    await self._room.wait()

    def _drop_gone(self) -> None:
        """Free the places of clients that gave up, before anything is spent on them."""
        for number, _ in self._ends.poll(0):
            turn = self._turns[self._waiting[number]]
            if not turn.done():
                self._admission.leave(self._waiting[number])
                turn.set_exception(ConnectionAbortedError())

    def _is_through(self, task: asyncio.Task[None], name: NodeName | None = None) -> None:
        if self._admission.over(task, name):
            self._room.set()

    def _note(self, line: HalfOpen, task: asyncio.Task[None], source: str) -> None:
        # Counted here: a task that is pushed out before it first ran could not do it.
        if line.add(task, source):
            self._on_refused(TOO_MANY_HANDSHAKES)

    def _close_unread(self, accepted: socket.socket, _: asyncio.Task[None]) -> None:
        """Close a socket whose task ended before asyncio took the socket, perhaps before the task first ran."""
        if accepted in self._unread:
            self._unread.discard(accepted)
            accepted.close()

    async def _admit(self, accepted: socket.socket, address: str, task: asyncio.Task[None]) -> bool:
        """Do the TLS handshake and connect to gRPC; return whether the connection stands."""
        outside = PipeEnd()
        try:
            transport, _ = await self._loop.connect_accepted_socket(
                lambda: outside,
                accepted,
                ssl=self._context,
                ssl_handshake_timeout=HANDSHAKE_TIMEOUT_S,
                ssl_shutdown_timeout=LAST_WORDS_S,
            )
        except (OSError, ssl.SSLError) as error:
            self._refused(address, *why_failed(error))
            # It forms a cycle with asyncio's TLS buffers: uncut, strangers take 100 MB before they are collected.
            error.__traceback__ = None
            return False
        _share_buffer(transport)
        try:
            certificate = transport.get_extra_info("ssl_object").getpeercert(binary_form=True)
            caller = self._check(certificate or b"")
        except CertificateError as error:
            self._refused(address, error.reason, str(error))
            outside.abort()
            return False
        return await self._connect(outside, caller, address, task)

    async def _connect(self, outside: PipeEnd, caller: Caller, address: str, task: asyncio.Task[None]) -> bool:
        if len(self._connections) >= MAX_TLS_CONNECTIONS:
            self._refused(address, TOO_MANY_CONNECTIONS, f"{MAX_TLS_CONNECTIONS} connections are open")
            outside.abort()
            return False
        if caller.refusal is None and caller.identity.role in _REGISTERS:
            self._admission.proven(task, caller.identity.name, self._loop.time())
        else:
            self._is_through(task)
        self._make_room(caller.identity.name)
        self._count += 1
        name = f"{self._prefix}-{self._count}"
        peer = f"unix-abstract:{name}"

        owner = caller.identity.name

        def lost() -> None:
            self._forget(peer, owner)
            self._is_through(task, owner)

        inside = PipeEnd(lost)
        # Must happen before gRPC learns of the connection.
        self._connections[peer] = _Connection(caller, outside, inside, task)
        self._of_name.setdefault(owner, OrderedDict())[peer] = None
        self._earliest_end.note(caller.identity.not_after)
        if caller.refusal is not None:
            # gRPC may tell it why, in words that its operator reads.
            self._refused_member(caller.identity.name, address, caller.refusal)
            self._loop.call_later(HANDSHAKE_TIMEOUT_S, outside.abort)
        try:
            await self._connect_inside(name, inside)
        except OSError as error:
            log.warning("no connection to the gRPC server: %s", error)
            lost()
            outside.abort()
            return False
        PipeEnd.join(outside, inside)
        return True

    async def _connect_inside(self, name: str, inside: PipeEnd) -> None:
        unix = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            unix.setblocking(False)
            unix.bind(f"\0{name}")
            await self._loop.sock_connect(unix, self._upstreams[self._count % len(self._upstreams)])
            await self._loop.create_unix_connection(lambda: inside, sock=unix)
        except BaseException:
            unix.close()
            raise

    def _make_room(self, name: NodeName) -> None:
        own = list(self._of_name.get(name, ()))
        for peer in own[: len(own) - MAX_CONNECTIONS_PER_NAME + 1]:
            connection = self._connections[peer]
            self._on_refused(TOO_MANY_CONNECTIONS)
            connection.outside.abort()
            connection.inside.abort()

    def _forget(self, peer: str, name: NodeName) -> None:
        if self._connections.pop(peer, None) is None:
            return
        own = self._of_name[name]
        del own[peer]
        if not own:
            del self._of_name[name]

    def _check(self, certificate: bytes) -> Caller:
        """Return the caller with its refusal, if any; raises CertificateError for one that our CA did not issue."""
        try:
            return Caller(self._good(certificate), certificate)
        except CertificateError as error:
            return Caller(self._trust.identify(certificate), certificate, error)

    def _good(self, certificate: bytes) -> Identity:
        identity = self._trust.check(certificate, self._clock.now())
        self._clock.note(identity.not_before)
        return identity

    def _review(self, connection: _Connection) -> None:
        """End the connection if its certificate is no longer valid."""
        caller = connection.caller
        if caller.refusal is not None:
            return
        try:
            self._good(caller.certificate)
        except CertificateError as error:
            refusal = error
        else:
            return
        connection.caller = Caller(caller.identity, caller.certificate, refusal)
        self._refused_member(caller.identity.name, caller.identity.name, refusal)
        self._loop.call_later(LAST_WORDS_S, connection.outside.abort)
        self._loop.call_later(LAST_WORDS_S, connection.inside.abort)

    def _refused_member(self, name: NodeName, who: str, refusal: CertificateError) -> None:
        """Log a refused member of our CA, for which somebody may look: always, though not at each attempt."""
        self._on_refused(refusal.reason)
        now = self._loop.time()
        told_at = self._told.get((name, refusal.reason), -math.inf)
        if now - told_at < TELL_AGAIN_S:
            return
        self._told[name, refusal.reason] = now
        self._told.move_to_end((name, refusal.reason))
        if len(self._told) > MAX_LOGGED_REFUSALS:
            self._told.popitem(last=False)
        log.warning("refused a connection of %s: %s: %s", who, refusal.reason, refusal)
        self.on_member_refused(name, refusal)

    def _refused(self, who: str, reason: str, text: str) -> None:
        self._on_refused(reason)
        # A stranger must not fill the disk.
        if self._log_lines.take(self._loop.time()):
            log.warning("refused a connection of %s: %s: %s", who, reason, text)


def _share_buffer(transport: asyncio.BaseTransport) -> None:
    """Let a TLS connection read into `_READ`; asyncio has no option for it."""
    protocol = transport._ssl_protocol  # type: ignore[attr-defined]
    assert len(protocol._ssl_buffer) == READ_SIZE
    protocol._ssl_buffer = _READ
    protocol._ssl_buffer_view = memoryview(_READ)


def _has_spoken(sock: socket.socket) -> bool:
    """Return whether there is something to read now, including the end of the connection."""
    looking = select.poll()
    looking.register(sock, select.POLLIN)
    return bool(looking.poll(0))


async def _readable(loop: asyncio.AbstractEventLoop, sock: socket.socket) -> None:
    """Wait until there is something to read, including the end of the connection."""
    readable = loop.create_future()

    def found() -> None:
        if not readable.done():
            readable.set_result(None)

    loop.add_reader(sock, found)
    try:
        await readable
    finally:
        loop.remove_reader(sock)


def _source(address: str) -> str:
    """Return what a sender of connections can hardly change: its IPv4 address, or its IPv6 network."""
    with contextlib.suppress(ValueError):
        ip = ipaddress.ip_address(address.partition("%")[0])
        if isinstance(ip, ipaddress.IPv6Address):
            if ip.ipv4_mapped is not None:
                return str(ip.ipv4_mapped)
            return str(ipaddress.IPv6Network((ip, 64), strict=False))
    return address
