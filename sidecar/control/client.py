"""Drives the control stream over gRPC on one thread with its own event loop, separate from the data plane.

ControlSession makes all decisions. The dialer makes the connections, and gRPC connects to the dialer. No thread that
moves datagrams calls anything here, or waits for it.

grpc.aio is used rather than a synchronous stub: with a report every 0.5 s, the latter needs two more threads and some
more wake-ups, each of which may take the interpreter from a data-plane thread.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from typing import TYPE_CHECKING, NamedTuple

import grpc

from plr.protos.base.errors import DecodeError, UnknownKindError
from plr.protos.convert import control_message_from_proto, sidecar_message_to_proto
from plr.protos.model.members import PeerSet, ServiceSet
from plr.protos.model.names import clean_text
from plr.protos.model.report import Report
from plr.protos.model.stream import ResourceKind, Welcome
from plr.protos.plr.v1 import control_pb2_grpc
from plr.protos.program import tls_advice
from plr.sidecar.control.channel import REFUSALS, open_channel
from plr.sidecar.control.outage_log import OutageLog
from plr.sidecar.control.refusal_log import RefusalLog
from plr.sidecar.core.control.session import Apply
from plr.sidecar.core.control.watch import CHEAPER

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from plr.protos.model.members import CandidateSet, RevocationSet
    from plr.protos.plr.v1 import control_pb2
    from plr.protos.program.tls_files import TlsWatch
    from plr.sidecar.control.hooks import ControlHooks
    from plr.sidecar.core.base.report_scope import ReportScope
    from plr.sidecar.core.control.session import ControlSession, ControlStats
    from plr.sidecar.net.control_dialer import ControlDialer, ControlLine
    from plr.sidecar.ports import ControlledDataPlane

    _Call = grpc.aio.StreamStreamCall[control_pb2.SidecarMessage, control_pb2.ControlMessage]

log = logging.getLogger(__name__)

GOODBYE_S = 0.5
"""How long `stop` waits for the control plane to take the goodbye."""

LOOK_INTERVAL_S = 1.0
"""How often to look for new certificate files and revocation lists, and for peers whose certificates have expired."""

JUDGE_AGAIN_S = 10.0
"""Interval between two judgements of refused peers: a robot without a clock learns the time soon after its start, and
4096 peers take a second of public-key work."""


class _StreamEndedError(Exception):
    """The stream is over.

    `refused`: by a decision of the control plane. `wanted`: by our own, to open another. `moved`: there is a better way
    to the control plane.
    """

    def __init__(self, reason: str, *, refused: bool = False, wanted: bool = False, moved: bool = False) -> None:
        super().__init__(reason)
        self.reason = reason
        self.refused = refused
        self.wanted = wanted
        self.moved = moved


class ControlView(NamedTuple):
    """State of the control stream at one moment; times are monotonic seconds."""

    names: tuple[str, ...]
    """As configured."""
    connected: bool
    since: float
    """When `connected` last changed, or the start."""
    way: str | None
    """Address and interface of the connection, in words."""
    interface: str | None
    last_failure: str | None
    """Why the last attempt or stream ended."""
    retry_at: float


class ControlClient:
    """Keeps one sidecar connected to the control plane that `dialer` reaches, until `stop`.

    `tls` holds the certificate to present; None in insecure mode.
    """

    def __init__(
        self,
        dialer: ControlDialer,
        session: ControlSession,
        data_plane: ControlledDataPlane,
        hooks: ControlHooks,
        tls: TlsWatch | None = None,
    ) -> None:
        self._dialer = dialer
        self._line: ControlLine | None = None
        self._tls = tls
        self._session = session
        self._data_plane = data_plane
        self._hooks = hooks
        self._connected = False
        self.last_failure: str | None = None
        """Why the last attempt or stream ended; None before that, or when we ended it."""
        self._changed_at = time.monotonic()
        self._stopping = False
        self._outage = OutageLog(log, ", ".join(dialer.names))
        self._refusals = RefusalLog(log)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._main_task: asyncio.Task[None] | None = None
        self._wake = asyncio.Event()
        self._new_files = asyncio.Event()
        self._running = threading.Event()
        self._thread = threading.Thread(target=self._run, name="plr-control", daemon=True)

    # ── from any thread ──

    @property
    def connected(self) -> bool:
        """Whether a stream is accepted."""
        return self._connected

    @property
    def stats(self) -> ControlStats:
        """Counters, read-only."""
        return self._session.stats

    def view(self) -> ControlView:
        """Return the state of the stream, for people."""
        line = self._line
        way = None if line is None else line.way
        return ControlView(
            self._dialer.names,
            self._connected,
            self._changed_at,
            None if way is None else str(way),
            None if way is None or way.interface is None else str(way.interface),
            self.last_failure,
            self._session.retry_at,
        )

    def start(self) -> None:
        """Connect in the background; call once."""
        self._thread.start()
        self._running.wait()

    def set_candidates(self, candidates: CandidateSet) -> None:
        """Tell the control plane at which addresses we are reachable now, and what is known of our interfaces."""
        self._post(lambda: self._session.set_candidates(candidates))

    def set_services(self, services: ServiceSet) -> None:
        """Tell the control plane what we offer and carry now."""
        self._post(lambda: self._session.set_services(services))

    def set_revocations(self, held: RevocationSet) -> None:
        """Tell the control plane which revocation lists we use now."""
        self._post(lambda: self._session.set_revocations(held))

    def report_at_once(self, scope: ReportScope) -> None:
        """Report only `scope` before the next report is due: something happened that the control plane should know."""
        self._post(lambda: self._session.report_at_once(time.monotonic(), scope))

    def try_again(self) -> None:
        """Try a refused mapping again: interfaces or peers have changed, and it may fit now."""
        self._post(self._try_refused)

    def drain(self) -> None:
        """Announce that we are leaving; requests in flight and the stream go on."""
        self._post(self._session.drain)

    def stop(self) -> None:
        """Say goodbye and end the thread; return after about GOODBYE_S at most, whatever the control plane does."""
        self._post(self._begin_stop)
        if self._thread.is_alive():
            self._thread.join(4.0 * GOODBYE_S)
            if self._thread.is_alive():
                log.warning("the control client did not stop in time and is abandoned")

    def _post(self, action: Callable[[], None]) -> None:
        """Run `action` on the control thread; before `start`, on the calling thread."""
        if self._loop is None:
            action()
            return

        def run() -> None:
            action()
            self._wake.set()

        # A loop that has just ended takes no calls; then there is nothing left to do.
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(run)

    # ── on the control thread ──

    def _run(self) -> None:
        try:
            asyncio.run(self._main())
        finally:
            self._running.set()
            self._note_connection(False, "stopped")

    async def _main(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._main_task = asyncio.current_task()
        self._running.set()
        judging = asyncio.create_task(self._look_at_credentials())
        self._dialer.start(self._network_changed)
        try:
            while not self._stopping:
                await self._wait_for_turn()
                if not self._stopping:
                    # In a separate task: a TaskGroup that ends with an error leaves a cancellation counted in its task.
                    # Up to Python 3.11.2 (Debian 12), that turns the next asyncio.timeout into the task's cancellation.
                    await asyncio.create_task(self._one_stream())
        except asyncio.CancelledError:
            if not self._stopping:
                raise  # ends the program, which is restarted: without this thread nothing ever connects
        finally:
            self._dialer.close()
            judging.cancel()

    def _network_changed(self) -> None:
        self._session.network_changed(time.monotonic())
        self._wake.set()

    async def _look_at_credentials(self) -> None:
        """Judge credentials periodically, even without any stream.

        While our clock is wrong, the control plane's certificate is no good either, and an operator's new revocation
        list counts even while the control plane is away.
        """
        again_at = time.monotonic() + JUDGE_AGAIN_S
        while True:
            await asyncio.sleep(min(LOOK_INTERVAL_S, JUDGE_AGAIN_S))
            with _logging_failure("judging credentials"):
                if self._look_for_new_files():
                    self._new_files.set()
                self._hooks.look_at_revocations()
                self._hooks.end_expired()
                if time.monotonic() >= again_at:
                    again_at = time.monotonic() + JUDGE_AGAIN_S
                    self._hooks.judge_again()

    def _begin_stop(self) -> None:
        self._stopping = True
        self._session.drain()
        if self._loop is not None and self._main_task is not None:
            self._loop.call_later(GOODBYE_S, self._main_task.cancel)

    async def _wait_for_turn(self) -> None:
        """Wait until the next attempt is due, or until stopped."""
        while not self._stopping and (delay_s := self._session.retry_at - time.monotonic()) > 0:
            self._wake.clear()
            await self._woken_within(delay_s)

    async def _woken_within(self, delay_s: float) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(max(delay_s, 0.0)):
                await self._wake.wait()

    async def _one_stream(self) -> None:
        """Open a stream, serve it until it ends, and note why it did."""
        self._look_for_new_files()
        self._new_files.clear()
        self._session.opened(time.monotonic())
        ended = _StreamEndedError("stopped")
        try:
            async with self._dialer.line() as line, self._open_channel(line.target) as channel:
                self._line = line
                call = control_pb2_grpc.ControlPlaneStub(channel).Connect()
                async with asyncio.TaskGroup() as tasks:
                    tasks.create_task(self._read(call))
                    tasks.create_task(self._write(call))
                    tasks.create_task(self._await_welcome(line))
                    tasks.create_task(self._await_end(line))
                    tasks.create_task(self._watch_files())
        except* _StreamEndedError as group:
            ended = _most_telling(group)
        except* Exception:
            log.exception("control stream failed")
            ended = _StreamEndedError("internal error", refused=True)
        finally:
            if self._line is not None and not ended.wanted:
                self._line.over(welcomed=self._connected, refused=ended.refused)
            self._line = None
            delay_s = self._session.closed(time.monotonic(), refused=ended.refused, moved=ended.moved)
        was_connected = self._connected
        self._note_connection(False, "stopped" if self._stopping else ended.reason)
        self.last_failure = None if ended.wanted else ended.reason
        if ended.wanted:
            log.info("opening a new control stream: %s", ended.reason)
        elif not self._stopping:
            self._outage.failed(ended.reason, delay_s, time.monotonic(), was_connected=was_connected)

    def _open_channel(self, target: str) -> grpc.aio.Channel:
        return open_channel(target, None if self._tls is None else self._tls.current)

    async def _await_end(self, line: ControlLine) -> None:
        """End the stream when there is no way to the control plane, or a better one than the stream's."""
        end = await asyncio.shield(line.ended)  # `over` reads it after this task was cancelled
        if isinstance(end, str):
            raise _StreamEndedError(end)
        raise _StreamEndedError(end.reason, wanted=end.cause == CHEAPER, moved=True)

    async def _watch_files(self) -> None:
        """End the stream when there is a new certificate to present."""
        await self._new_files.wait()
        raise _StreamEndedError("new certificate files", wanted=True)

    def _look_for_new_files(self) -> bool:
        files = self._tls.poll() if self._tls is not None else None
        if files is None:
            return False
        with _logging_failure("certificate_changed"):
            self._hooks.certificate_changed(files)
        return True

    def _ended_by(self, error: grpc.aio.AioRpcError) -> _StreamEndedError:
        code = error.code()
        reason = clean_text(f"{code.name}: {error.details() or 'no details'}")
        advice = None
        if code is grpc.StatusCode.UNAVAILABLE and self._connected and self._line is not None and self._line.broken:
            reason = f"{code.name}: {self._line.broken}"
        if code is grpc.StatusCode.UNAVAILABLE and not self._connected:
            # All of it: why TLS failed stands at its end.
            advice = tls_advice.explain(
                error.details() or "", self._tls.current if self._tls is not None else None, time.time()
            )
        return _StreamEndedError(advice or reason, refused=code in REFUSALS)

    async def _read(self, call: _Call) -> None:
        try:
            async for message in call:
                self._on_message(message)
                self._wake.set()
        except grpc.aio.AioRpcError as error:
            raise self._ended_by(error) from error
        except asyncio.CancelledError as error:
            task = asyncio.current_task()
            if task is None or task.cancelling():
                raise
            # The call was cancelled, not this task.
            raise _StreamEndedError("cancelled") from error
        raise _StreamEndedError("closed by the control plane")

    async def _write(self, call: _Call) -> None:
        while True:
            self._wake.clear()
            # Read before the messages are collected: a stop during the writes below must still send its goodbye.
            stopping = self._stopping
            now = time.monotonic()
            self._session.handle_timer(now)
            scope = self._session.report_due(now)
            if scope is not None:
                self._session.send_report(self._take_report(scope), now)
            try:
                for message in self._session.messages_to_send(now):
                    await call.write(sidecar_message_to_proto(message))
                if stopping:
                    await call.done_writing()
                    return
            except (grpc.aio.AioRpcError, asyncio.InvalidStateError):
                # The stream has ended; the reader learns why.
                return
            await self._woken_within(self._session.next_timer() - time.monotonic())

    async def _await_welcome(self, line: ControlLine) -> None:
        """Give up on an overdue welcome: in a network that swallows everything, gRPC alone would try for 20 s."""
        await asyncio.sleep(max(self._session.next_timer() - time.monotonic(), 0.0))
        if self._session.welcome_overdue(time.monotonic()):
            raise _StreamEndedError(line.describe() or f"no answer to the registration at {line.way}")

    def _on_message(self, message: control_pb2.ControlMessage) -> None:
        try:
            value = control_message_from_proto(message)
        except UnknownKindError as error:
            if self._session.unknown() == 1:
                log.info("left out %s", error)
            return
        except DecodeError as error:
            resource, nonce = _what_it_was(message)
            self._refusals.refused(resource, "a message of the control plane", str(error))
            self._session.undecodable(resource, nonce, str(error))
            return
        match self._session.receive(value, time.monotonic()):
            case Welcome() as welcome:
                self._on_welcome(welcome)
            case Apply() as apply:
                self._apply(apply)

    def _on_welcome(self, welcome: Welcome) -> None:
        if not self._connected and self._line is not None:
            self._line.let_in()
            self._outage.over(str(self._line.way))
        with _logging_failure("welcome"):
            self._hooks.welcome(welcome)
        self._note_connection(True, "registered")

    def _apply(self, apply: Apply) -> None:
        error, failure = self._put_in_force(apply)
        self._session.applied(apply, error)
        if error is None:
            self._refusals.taken(apply.resource)
        else:
            what = f"{apply.resource.value} version {apply.content.version}"
            self._refusals.refused(apply.resource, what, error, failure)

    def _put_in_force(self, apply: Apply) -> tuple[str | None, Exception | None]:
        """Return why it is refused, or None, and the internal failure behind that, if any."""
        content = apply.content
        try:
            if isinstance(content, PeerSet):
                error = self._data_plane.apply_peers(content)
            else:
                error = self._data_plane.apply_mapping(content)
            if error is None:
                self._hooks.applied(content)
        except Exception as failure:
            return f"internal error: {failure}", failure
        return error, None

    def _try_refused(self) -> None:
        apply = self._session.refused
        if apply is not None and self._put_in_force(apply)[0] is None:
            self._session.applied_late()
            self._refusals.taken(apply.resource)
            log.info(
                "%s version %d, which was refused before, is in force now", apply.resource.value, apply.content.version
            )

    def _take_report(self, scope: ReportScope) -> Report:
        report = Report()
        with _logging_failure("taking a report"):
            report = self._data_plane.take_report(scope)
        return report

    def _note_connection(self, connected: bool, reason: str) -> None:
        if connected == self._connected:
            return
        self._connected, self._changed_at = connected, time.monotonic()
        with _logging_failure("connection_changed"):
            self._hooks.connection_changed(connected, reason)


@contextlib.contextmanager
def _logging_failure(what: str) -> Iterator[None]:
    """Log an internal error of the rest of the sidecar, which must not end the stream."""
    try:
        yield
    except Exception:
        log.exception("%s failed", what)


def _most_telling(group: BaseExceptionGroup[_StreamEndedError]) -> _StreamEndedError:
    endings = [error for error in group.exceptions if isinstance(error, _StreamEndedError)]
    return next((error for error in endings if error.refused), endings[0])


def _what_it_was(message: control_pb2.ControlMessage) -> tuple[ResourceKind | None, int]:
    match message.WhichOneof("kind"):
        case "peers":
            return ResourceKind.PEERS, message.peers.nonce
        case "mapping":
            return ResourceKind.MAPPING, message.mapping.nonce
        case _:
            return None, 0
