"""Serves `ControlPlane.Connect` over gRPC: moves messages between one stream and the loop."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, NamedTuple, NoReturn

import grpc

from plr.controlplane.core.publish.messages import CloseReason
from plr.controlplane.core.registry.registry import Refusal
from plr.controlplane.serve.access import first_words
from plr.controlplane.serve.stream_encoder import StreamEncoder
from plr.controlplane.serve.stream_limits import (
    MAX_FIRST_BYTES,
    MAX_STREAMS_PER_NAME,
    TOO_FAST,
    TOO_MANY_STREAMS,
    MemberRates,
    StreamCount,
    announced_entries,
)
from plr.protos.base.errors import DecodeError, UnknownKindError
from plr.protos.convert import (
    parse_in_parts,
    parse_sidecar_message,
    read_sidecar_message,
    sidecar_message_from_proto,
)
from plr.protos.convert.reports import report_entries
from plr.protos.model.members import Registration
from plr.protos.model.names import node_name
from plr.protos.model.protocol_versions import Spoken, refusal
from plr.protos.model.report import Report
from plr.protos.model.stream import Heartbeat
from plr.protos.plr.v1 import control_pb2

if TYPE_CHECKING:
    from plr.controlplane.core.registry.registry import StreamId
    from plr.controlplane.loop import ControlLoop
    from plr.controlplane.serve.mailbox import Mailbox
    from plr.controlplane.serve.tls_gate import Caller, TlsGate
    from plr.protos.model.ids import NodeName
    from plr.protos.model.stream import SidecarMessage

    Context = grpc.aio.ServicerContext[bytes, bytes]

SERVICE_NAME = control_pb2.DESCRIPTOR.services_by_name["ControlPlane"].full_name

REGISTER_TIMEOUT_S = 10.0
"""A stream that stays silent for this long after it was opened is closed: longer than any sidecar's start takes."""

REGISTERED_AT_ONCE = 4
"""Registrations in one turn of the loop."""

LOOK_AGAIN_S = 1.0
"""Longest pause for a member that sent too much, before its share is checked again."""

SHORT_BYTES = 4096
"""A message up to this length is parsed at once."""

_REFUSAL_CODES = {
    Refusal.OLDER_INCARNATION: grpc.StatusCode.ABORTED,
    Refusal.NAME_TAKEN: grpc.StatusCode.ALREADY_EXISTS,
    Refusal.SESSION_TAKEN: grpc.StatusCode.ALREADY_EXISTS,
    Refusal.FULL: grpc.StatusCode.RESOURCE_EXHAUSTED,
    Refusal.TOO_OFTEN: grpc.StatusCode.RESOURCE_EXHAUSTED,
    Refusal.NAME_MISMATCH: grpc.StatusCode.PERMISSION_DENIED,
    Refusal.WRONG_ROLE: grpc.StatusCode.PERMISSION_DENIED,
    Refusal.BAD_CREDENTIAL: grpc.StatusCode.PERMISSION_DENIED,
    Refusal.VERSION: grpc.StatusCode.FAILED_PRECONDITION,
    Refusal.MALFORMED: grpc.StatusCode.INVALID_ARGUMENT,
}

_CLOSE_CODES = {
    CloseReason.REPLACED: grpc.StatusCode.ABORTED,
    CloseReason.LEASE_EXPIRED: grpc.StatusCode.DEADLINE_EXCEEDED,
    CloseReason.STOPPING: grpc.StatusCode.UNAVAILABLE,
    CloseReason.REVOKED: grpc.StatusCode.UNAUTHENTICATED,
    CloseReason.CERTIFICATE_ENDED: grpc.StatusCode.UNAUTHENTICATED,
}


class _NoRegistration(NamedTuple):
    """Why a first message is refused."""

    refusal: Refusal
    details: str
    claimed: NodeName | None = None
    """Who sent it, if it says so."""

    @property
    def code(self) -> grpc.StatusCode:
        return _REFUSAL_CODES[self.refusal]


_NOT_A_REGISTRATION = _NoRegistration(Refusal.MALFORMED, "the first message has to be a registration")


class _StreamEndError(Exception):
    """The stream ends with this status; None: the sidecar ended it."""

    def __init__(self, code: grpc.StatusCode | None, details: str) -> None:
        super().__init__(details)
        self.code = code
        self.details = details


class ControlPlaneService:
    """Serves `Connect`. Bytes are parsed here, not by gRPC, so that bad ones get a clear status.

    `report_interval_s` is sent to the sidecars.
    `gate` knows who is behind a peer of gRPC; None in insecure mode, where a sidecar is believed to be who it says.
    """

    def __init__(self, loop: ControlLoop, report_interval_s: float, gate: TlsGate | None) -> None:
        self._loop = loop
        self._gate = gate
        self._streams = StreamCount()
        self._rates = MemberRates(report_interval_s=report_interval_s)
        self._turn = asyncio.Semaphore(REGISTERED_AT_ONCE)
        self._encoder = StreamEncoder()

    def add_to(self, server: grpc.aio.Server) -> None:
        """Serve on this server."""
        handler: grpc.RpcMethodHandler[bytes, bytes] = grpc.stream_stream_rpc_method_handler(
            self.connect,
        )
        server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(SERVICE_NAME, {"Connect": handler}),))

    async def connect(self, _: object, context: Context) -> None:
        """Serve one stream until either side ends it."""
        who = context.peer()
        try:
            caller = await self._caller_of(context)
            if caller is not None:
                who = caller.identity.name
            if not self._streams.enter(who):
                self._loop.refused(TOO_MANY_STREAMS)
                await first_words(context)
                raise _StreamEndError(
                    grpc.StatusCode.RESOURCE_EXHAUSTED, f"{who} has {MAX_STREAMS_PER_NAME} streams open"
                )
            try:
                await self._serve(context, caller)
            finally:
                self._streams.leave(who)
        except _StreamEndError as end:
            if end.code is not None:
                address = context.peer() if self._gate is None else self._gate.address(context.peer())
                self._loop.stream_ended(who, address, end.code.name.lower(), end.details)
                await context.abort(end.code, end.details)

    async def _serve(self, context: Context, caller: Caller | None) -> NoReturn:
        try:
            name, stream, mailbox, incremental = await self._register(context, caller)
        finally:
            if self._gate is not None:
                self._gate.is_served(context.peer())
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(self._write(mailbox, context, incremental=incremental))
                tasks.create_task(self._read(name, stream, context))
        except BaseExceptionGroup as group:
            end = _only_end(group)
            if end is None:
                raise
        else:
            raise AssertionError("neither task ends but by an exception")
        finally:
            self._loop.disconnected(stream)
        raise _StreamEndError(*end)

    async def _register(self, context: Context, caller: Caller | None) -> tuple[NodeName, StreamId, Mailbox, bool]:
        """Return the stream's member, its id, its mailbox, and whether it takes incremental changes."""
        try:
            async with asyncio.timeout(REGISTER_TIMEOUT_S):
                found = _first_message(await self._receive(context))
        except TimeoutError:
            raise _StreamEndError(grpc.StatusCode.DEADLINE_EXCEEDED, "no registration arrived") from None
        if not isinstance(found, Registration):
            self._loop.refuse(found.claimed if caller is None else caller.identity.name, found.refusal, found.details)
            raise _StreamEndError(found.code, found.details)
        registration = found
        async with self._turn:
            # Register few in each turn of the loop: messages of registered members come in between.
            await asyncio.sleep(0)
            result = self._loop.register(registration, caller)
        if isinstance(result, Refusal):
            raise _StreamEndError(_REFUSAL_CODES[result], f"{registration.name}: {result.value}")
        return registration.name, *result, registration.incremental

    async def _caller_of(self, context: Context) -> Caller | None:
        if self._gate is None:
            return None
        caller = self._gate.caller(context.peer())
        # The guard saw a caller a moment ago; a connection that has ended since must not count as insecure mode.
        if caller is None:
            raise _StreamEndError(grpc.StatusCode.UNAUTHENTICATED, "the connection has ended")
        if caller.refusal is not None:
            await first_words(context)
            raise _StreamEndError(grpc.StatusCode.UNAUTHENTICATED, str(caller.refusal))
        return caller

    @staticmethod
    async def _receive(context: Context) -> bytes:
        data = await context.read()
        if not isinstance(data, bytes):
            raise _StreamEndError(None, "the sidecar ended the stream")
        return data

    async def _read(self, name: NodeName, stream: StreamId, context: Context) -> NoReturn:
        told = False
        malformed: str | None = None
        shares = self._loop.report_shares
        while True:
            data = await self._receive(context)
            if not self._rates.take(name, len(data), time.monotonic()):
                raise self._too_fast("messages arrive too fast")
            try:
                parts: list[SidecarMessage]
                try:
                    parts = await self._parse(data)
                except UnknownKindError as error:
                    self._loop.unknown_message(name, str(error), again=told)
                    told, parts = True, [Heartbeat()]
                if not self._rates.take_entries(name, sum(map(announced_entries, parts)), time.monotonic()):
                    raise self._too_fast("large announcements arrive too fast")
                if len(parts) == 1:
                    await self._loop.prepare(parts[0])
                    self._loop.receive(stream, parts[0])
                else:
                    async for _ in self._loop.turns.each(parts, lambda part: self._loop.receive(stream, part)):
                        pass
            except DecodeError as error:
                malformed = str(error)
            if malformed is not None:
                # Raised out here: an error keeps alive all that was parsed where it was raised.
                raise _StreamEndError(grpc.StatusCode.INVALID_ARGUMENT, malformed)
            entries = sum(report_entries(part) for part in parts if isinstance(part, Report))
            if entries and shares.take(name, entries, time.monotonic()):
                while wait_s := shares.wait_s(name, time.monotonic()):  # noqa: ASYNC110 - the load may be over sooner
                    await asyncio.sleep(min(wait_s, LOOK_AGAIN_S))

    def _too_fast(self, details: str) -> _StreamEndError:
        self._loop.refused(TOO_FAST)
        return _StreamEndError(grpc.StatusCode.RESOURCE_EXHAUSTED, details)

    async def _parse(self, data: bytes) -> list[SidecarMessage]:
        """Parse a message; a long report in parts, in turns with whatever else is due."""
        if len(data) <= SHORT_BYTES:
            return [parse_sidecar_message(data)]
        parts: list[SidecarMessage] = []
        async for found in self._loop.turns.each(parse_in_parts(data), lambda part: part):
            parts += found
        return parts

    async def _write(self, mailbox: Mailbox, context: Context, *, incremental: bool) -> NoReturn:
        while True:
            message = await mailbox.get()
            if isinstance(message, CloseReason):
                raise _StreamEndError(_CLOSE_CODES[message], message.value)
            for data in self._encoder.encode(message, incremental=incremental):
                try:
                    await context.write(data)
                except grpc.aio.InternalError as error:
                    # The connection broke during the message: this is how gRPC reports it to a writer.
                    raise _StreamEndError(None, "the connection broke") from error


_End = tuple[grpc.StatusCode | None, str]
"""The final status of a stream, and details. Returned, not raised where it is found: an error keeps alive all that was
parsed there."""


def _only_end(group: BaseExceptionGroup) -> _End | None:
    """Return why a stream ends, if nothing else is in the group."""
    ends, others = group.split(_StreamEndError)
    if others is not None or ends is None:
        return None
    first = ends.exceptions[0]
    while isinstance(first, BaseExceptionGroup):
        first = first.exceptions[0]
    return first.code, first.details


def _first_message(data: bytes) -> Registration | _NoRegistration:
    """Return the registration that a stream begins with, or why it ends."""
    if len(data) > MAX_FIRST_BYTES:
        return _NOT_A_REGISTRATION
    try:
        message = read_sidecar_message(data)
        kind = message.WhichOneof("kind")
        if kind == "register":
            # Checked first: a message of another version may have another meaning.
            oldest = message.register.protocol_version
            problem = refusal(Spoken(oldest, message.register.newest_protocol_version or oldest))
            if problem is not None:
                return _NoRegistration(Refusal.VERSION, problem, _claimed_name(message.register.name))
        elif kind is not None:
            return _NOT_A_REGISTRATION
        registration = sidecar_message_from_proto(message)
    except DecodeError as error:
        return _NoRegistration(Refusal.MALFORMED, str(error))
    return registration if isinstance(registration, Registration) else _NOT_A_REGISTRATION


def _claimed_name(name: str) -> NodeName | None:
    try:
        return node_name(name, "name")
    except DecodeError:
        return None
