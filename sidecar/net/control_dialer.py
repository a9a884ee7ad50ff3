"""Lets gRPC, which knows nothing about interfaces, reach the control plane over any that lives.

    gRPC ──private Unix socket──▶ here ──TCP, bound to an interface──▶ control plane
      ╚═══════════════════════════ TLS, end to end ════════════════════════╝

Every stream has a line: gRPC's one connection, and the TCP connection behind it, which wins a race over interfaces and
addresses (`plr.sidecar.core.control.race`) and is watched (`plr.sidecar.core.control.watch`). Bytes are passed on
unchanged. The cores make all decisions.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from plr.protos.base.host_port import numeric_host
from plr.sidecar.core.control.race import ControlRace
from plr.sidecar.core.control.watch import CHEAPER, GONE, SILENT, ControlWatch, Leave
from plr.sidecar.core.control.ways import STRANGER, ControlWays, Life, WayClass
from plr.sidecar.net.control_attempts import Attempts, words
from plr.sidecar.net.control_sockets import NotAllowedError, is_ours, listen_privately, look, own_address
from plr.sidecar.net.host_names import HostNames

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Mapping, Sequence

    from plr.protos.model.ids import Address, InterfaceName
    from plr.sidecar.core.base.values import PathState
    from plr.sidecar.core.control.session import ControlStats
    from plr.sidecar.core.control.ways import ControlInterface, Way

log = logging.getLogger(__name__)

CHUNK_BYTES = 65_536
"""Most bytes passed on at once; no more is held here in either direction."""

MAX_KEPT_ADDRESSES = 4
"""Addresses remembered because a control plane registered us there, for when its name cannot be looked up."""

TRY_CHEAPER_S = 2.0
"""Time that a cheaper interface has to connect while the stream goes on over the dearer one."""

PREPARED_S = 5.0
"""Time within which a connection made in advance is used, or not at all."""

ACCEPT_PAUSE_S = 0.1
"""Pause after the system refused to accept."""

ROUTING_TABLE = "none"
"""Metrics label for the interface of a connection that the routing table led over an interface that is not ours."""


@dataclass(frozen=True, slots=True)
class _Connection:
    way: Way
    sock: socket.socket


class ControlDialer:
    """Keeps what is known about the ways to the control plane across streams."""

    def __init__(
        self,
        names: tuple[str, ...],
        stats: ControlStats,
        kept: Sequence[Address] = (),
        remember: Callable[[tuple[Address, ...]], None] = lambda addresses: None,
        check_paths: Callable[[InterfaceName], None] = lambda interface: None,
    ) -> None:
        """Take the control plane's `names` (host:port) and the addresses that worked in an earlier run (`kept`).

        `remember` is called with the addresses to keep. `check_paths` asks the data plane to find out now whether an
        interface carries anything; `set_paths` follows.
        """
        self.names = names
        self.stats = stats
        self.ways = ControlWays(stats.dial_drops)
        self._found: tuple[Address, ...] = tuple(one for name in names if (one := numeric_host(name)) is not None)
        self._kept = tuple(kept)
        self._remember = remember
        self.check_paths = check_paths
        self._has_names = len(self._found) < len(names)
        self._resolver = HostNames("control plane", lambda addresses: self._post(lambda: self._use(addresses)))
        self._line: ControlLine | None = None
        self._prepared: tuple[_Connection, float] | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._hope: Callable[[], None] = lambda: None
        self._told_not_allowed = False
        self._use(self._found)

    # -- from any thread ------------------------------------------------------------------------------------------

    def set_interfaces(self, interfaces: Sequence[ControlInterface]) -> None:
        """Replace the interfaces that can carry something now."""

        def act() -> None:
            new = any(not self.ways.has(interface.name) for interface in interfaces)
            self.ways.set_interfaces(interfaces, time.monotonic())
            if new and self._has_names:
                self._resolver.look_up(self.names)  # this network's DNS may know what the last one did not
            self._changed(hopeful=new)

        self._post(act)

    def set_paths(self, best: Mapping[InterfaceName, PathState]) -> None:
        """Replace the best state of the data plane's paths over each interface that has some."""

        def act() -> None:
            dead = [name for name in best if self.ways.life(name) is not Life.LIVING]
            self.ways.set_paths(best, time.monotonic())
            self._changed(hopeful=any(self.ways.life(name) is Life.LIVING for name in dead))

        self._post(act)

    def _post(self, action: Callable[[], None]) -> None:
        if self._loop is None:
            action()
            return
        # A loop that has just ended takes no calls, but then there is nothing left to dial for.
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(action)

    # -- on the control thread ------------------------------------------------------------------------------------

    def start(self, hope: Callable[[], None]) -> None:
        """Start on the running loop; `hope` is called when an attempt may succeed that could not before."""
        self._loop = asyncio.get_running_loop()
        self._hope = hope
        if self._has_names:
            self._resolver.look_up(self.names)
            self._resolver.start()

    def close(self) -> None:
        """Stop looking up names, and drop the prepared connection."""
        self._resolver.stop()
        self._drop_prepared()

    @contextlib.asynccontextmanager
    async def line(self) -> AsyncIterator[ControlLine]:
        """Listen for gRPC's connection, and serve it until the end of the block; raises OSError."""
        line = self._line = ControlLine(self)
        serving = asyncio.create_task(line.serve())
        try:
            yield line
        finally:
            self._line = None
            serving.cancel()
            await asyncio.wait([serving])
            line.close()

    def let_in(self, way: Way) -> None:
        """Note that a control plane registered us at the other end of this way."""
        self.ways.proven(way)
        kept = tuple(dict.fromkeys((way.address, *self._kept)))[:MAX_KEPT_ADDRESSES]
        if self._has_names and kept != self._kept:
            self._kept = kept
            self._remember(kept)

    def take_prepared(self) -> _Connection | None:
        """Take the connection that was made in advance, if it is still good."""
        if self._prepared is None:
            return None
        connection, at = self._prepared
        if time.monotonic() > at + PREPARED_S:
            self._drop_prepared()
            return None
        self._prepared = None
        return connection

    def prepare(self, connection: _Connection) -> None:
        """Keep a connection for the next line."""
        self._drop_prepared()
        self._prepared = connection, time.monotonic()

    def _drop_prepared(self) -> None:
        if self._prepared is not None:
            self._prepared[0].sock.close()
            self._prepared = None

    def _use(self, addresses: tuple[Address, ...]) -> None:
        """Use these looked-up addresses. Those that worked stay: a network may answer any name with its own portal."""
        self._found = addresses
        self.ways.set_addresses((*addresses, *self._kept))
        self._changed(hopeful=True)

    def _changed(self, *, hopeful: bool) -> None:
        if self._line is not None:
            self._line.wake.set()
        if hopeful:
            self._hope()

    def may_not_bind(self, error: OSError) -> None:
        """Follow the routing table from now on."""
        self.ways.can_bind = False
        if not self._told_not_allowed:
            self._told_not_allowed = True
            log.warning(
                "not allowed to bind to a device (CAP_NET_RAW): the control stream follows the routing table (%s)",
                error.strerror,
            )


class ControlLine:
    """gRPC's connection for one stream, and the connection behind it. Made by `ControlDialer.line`."""

    def __init__(self, dialer: ControlDialer) -> None:
        self._dialer = dialer
        self._loop = asyncio.get_running_loop()
        self._listening, self.target = listen_privately()
        self.wake = asyncio.Event()
        """Set when something in the network has changed."""
        self.ended: asyncio.Future[Leave | str] = self._loop.create_future()
        """The decision to leave the connection, or why there is none. gRPC notices by itself when it is closed."""
        self.way: Way | None = None
        """The way it takes, once it is connected."""
        self.broken: str | None = None
        """The kernel's error when the connection broke."""
        self._race: ControlRace | None = None

    def close(self) -> None:
        """Stop listening, which `serve` does only if it has run."""
        self._listening.close()

    def describe(self) -> str | None:
        """Return why there is no connection yet; None if there is one."""
        if self.way is not None:
            return None
        if self._dialer.ways.empty:
            return f"no address of {', '.join(self._dialer.names)} is known"
        return "no connection has been tried" if self._race is None else self._race.outcome()

    def let_in(self) -> None:
        """Note that a control plane registered us."""
        if self.way is not None:
            self._dialer.let_in(self.way)

    def over(self, *, welcomed: bool, refused: bool) -> None:
        """Note that the stream has ended: `refused` by the control plane, or without ever being `welcomed`."""
        if self.way is not None and not welcomed and not self.ended.done():
            self._dialer.ways.failed(self.way, time.monotonic(), whole_address=refused)
            self._dialer.ways.disappointed(self.way.interface)

    async def serve(self) -> None:
        """Accept gRPC's connection, connect and pass bytes on; cancelled when the stream is over."""
        try:
            with self._listening:
                inside = await self._accept()
            with inside:
                connection = self._dialer.take_prepared() or await self._connect()
                if connection is None:
                    self._end(self.describe() or "not connected")
                    return
                with connection.sock:
                    await self._carry(inside, connection)
        except OSError as error:
            self._end(f"the connection to the control plane failed: {words(error)}")
        except Exception:
            log.exception("the connection to the control plane failed")
            self._end("internal error")

    def _end(self, why: Leave | str) -> None:
        if not self.ended.done():
            self.ended.set_result(why)

    async def _accept(self) -> socket.socket:
        while True:
            try:
                accepted, _ = await self._loop.sock_accept(self._listening)
            except OSError as error:
                log.warning("cannot accept the control stream's connection: %s", error)
                await asyncio.sleep(ACCEPT_PAUSE_S)
                continue
            if is_ours(accepted):
                return accepted
            accepted.close()
            self._dialer.stats.dial_drops[STRANGER] += 1

    # -- connecting -----------------------------------------------------------------------------------------------

    async def _connect(self) -> _Connection | None:
        """Race over all ways; return None when every one has failed."""
        ways = self._dialer.ways
        attempts = Attempts()
        try:
            while True:
                self.wake.clear()
                now = time.monotonic()
                self._race = race = ControlRace(ways.classes(now), now, attempts.keep(now, ways))
                connection = await self._run(race, attempts, self.wake)
                if connection is not None or not self.wake.is_set():
                    return connection
        finally:
            attempts.close()

    async def _run(self, race: ControlRace, attempts: Attempts, wake: asyncio.Event) -> _Connection | None:
        """Run a race until a way wins, every way has failed, or `wake` is set."""
        while not wake.is_set():
            now = time.monotonic()
            for way in race.due(now):
                attempts.start(way, now)
            if race.over and not self._dialer.ways.empty:
                return None
            due = race.next_timer()
            await attempts.wait(wake, None if due is None else due - now)
            for way, outcome in attempts.take_ended():
                if isinstance(outcome, socket.socket):
                    return _Connection(way, outcome)
                if isinstance(outcome, NotAllowedError):
                    self._dialer.may_not_bind(outcome)
                    wake.set()
                race.failed(way, words(outcome), time.monotonic())
        return None

    async def _connect_cheaper(self, ways: tuple[Way, ...]) -> _Connection | None:
        now = time.monotonic()
        attempts = Attempts()
        try:
            async with asyncio.timeout(TRY_CHEAPER_S):
                return await self._run(ControlRace([WayClass(ways, 0.0)], now), attempts, asyncio.Event())
        except TimeoutError:
            return None
        finally:
            attempts.close()

    # -- connected ------------------------------------------------------------------------------------------------

    async def _carry(self, inside: socket.socket, connection: _Connection) -> None:
        way, outside = connection.way, connection.sock
        ways, stats = self._dialer.ways, self._dialer.stats
        over = way.interface or ways.owner(own_address(outside))
        self.way = way
        stats.connections[over or ROUTING_TABLE] += 1
        log.debug("control plane: connected to %s", way)
        watch = ControlWatch(ways, way, over, time.monotonic())

        def sent() -> None:
            watch.sent(time.monotonic())
            self.wake.set()

        tasks = [
            asyncio.create_task(self._pass_on(inside, outside, sent)),
            asyncio.create_task(self._pass_on(outside, inside, lambda: None)),
            asyncio.create_task(self._watch(watch, outside)),
        ]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks)
        for task in tasks:
            error = None if task.cancelled() else task.exception()
            if isinstance(error, OSError):
                self.broken = f"{words(error)} ({way})"
            elif error is not None:
                raise error
        with contextlib.suppress(OSError):
            outside.shutdown(socket.SHUT_WR)

    async def _pass_on(self, source: socket.socket, sink: socket.socket, done: Callable[[], None]) -> None:
        while data := await self._loop.sock_recv(source, CHUNK_BYTES):
            await self._loop.sock_sendall(sink, data)
            done()

    async def _watch(self, watch: ControlWatch, outside: socket.socket) -> None:
        """Watch the connection until it has to be left."""
        while True:
            self.wake.clear()
            watch.saw(look(outside), time.monotonic())
            leave = watch.judge(time.monotonic())
            doubted = watch.take_doubt(time.monotonic())
            if doubted is not None:
                self._dialer.check_paths(doubted)
            if leave is not None and (leave.cause != CHEAPER or await self._moved(leave)):
                break
            now = time.monotonic()
            due = watch.next_timer(now)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(None if due is None else max(due - now, 0.0)):
                    await self.wake.wait()
        self._dialer.stats.connections_left[leave.cause] += 1
        if leave.cause == SILENT and self.way is not None:
            self._dialer.ways.fell_silent(self.way, watch.over, time.monotonic())
        elif leave.cause == GONE:
            self._dialer.ways.disappointed(watch.over)
        self._end(leave)

    async def _moved(self, leave: Leave) -> bool:
        """Connect over a cheaper interface before the dearer one is left; return whether that worked."""
        connection = await self._connect_cheaper(leave.to)
        if connection is None:
            for way in leave.to:
                self._dialer.ways.failed(way, time.monotonic())
            return False
        self._dialer.prepare(connection)
        return True
