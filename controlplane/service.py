"""The gRPC side of `ControlPlane.Connect`: moves messages between one stream and the loop."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, NoReturn

import grpc
from google.protobuf.message import DecodeError as ProtobufDecodeError

from controlplane.core.control_events import CloseReason
from controlplane.core.registry import Refusal
from protos.convert import control_message_to_proto, parse_sidecar_message
from protos.errors import DecodeError
from protos.model import PROTOCOL_VERSION, Registration
from protos.plr.v1 import control_pb2

if TYPE_CHECKING:
    from controlplane.core.registry import StreamId
    from controlplane.loop import ControlLoop
    from controlplane.mailbox import Mailbox
    from protos.model import SidecarMessage

    Context = grpc.aio.ServicerContext[bytes, control_pb2.ControlMessage]

SERVICE_NAME = control_pb2.DESCRIPTOR.services_by_name["ControlPlane"].full_name

REGISTER_TIMEOUT_S = 10.0
"""A stream that says nothing for this long after it was opened is closed: slower than any sidecar's start."""

_REFUSAL_CODES = {
    Refusal.OLDER_INCARNATION: grpc.StatusCode.ABORTED,
    Refusal.NAME_TAKEN: grpc.StatusCode.ALREADY_EXISTS,
    Refusal.SESSION_TAKEN: grpc.StatusCode.ALREADY_EXISTS,
    Refusal.FULL: grpc.StatusCode.RESOURCE_EXHAUSTED,
}

_CLOSE_CODES = {
    CloseReason.REPLACED: grpc.StatusCode.ABORTED,
    CloseReason.LEASE_EXPIRED: grpc.StatusCode.DEADLINE_EXCEEDED,
    CloseReason.STOPPING: grpc.StatusCode.UNAVAILABLE,
}


class _StreamEndError(Exception):
    """The stream ends with this status; None: the sidecar ended it."""

    def __init__(self, code: grpc.StatusCode | None, details: str) -> None:
        super().__init__(details)
        self.code = code
        self.details = details


class ControlPlaneService:
    """Serves `Connect`. Bytes are parsed here, not by gRPC, so that bad ones get a clear status."""

    def __init__(self, loop: ControlLoop) -> None:
        self._loop = loop

    def add_to(self, server: grpc.aio.Server) -> None:
        """Serve on this server."""
        handler: grpc.RpcMethodHandler[bytes, control_pb2.ControlMessage] = grpc.stream_stream_rpc_method_handler(
            self.connect,
            response_serializer=control_pb2.ControlMessage.SerializeToString,
        )
        server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(SERVICE_NAME, {"Connect": handler}),))

    async def connect(self, _: object, context: Context) -> None:
        """Serve one stream until either side ends it."""
        try:
            await self._serve(context)
        except _StreamEndError as end:
            if end.code is not None:
                self._loop.stream_ended(context.peer(), end.code.name.lower(), end.details)
                await context.abort(end.code, end.details)

    async def _serve(self, context: Context) -> NoReturn:
        stream, mailbox = await self._register(context)
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(self._write(mailbox, context))
                tasks.create_task(self._read(stream, context))
        except BaseExceptionGroup as group:
            ends, others = group.split(_StreamEndError)
            if others is not None or ends is None:
                raise
            raise ends.exceptions[0] from None
        finally:
            self._loop.disconnected(stream)
        raise AssertionError("neither task ends but by an exception")

    async def _register(self, context: Context) -> tuple[StreamId, Mailbox]:
        try:
            async with asyncio.timeout(REGISTER_TIMEOUT_S):
                data = await self._receive(context)
        except TimeoutError:
            raise _StreamEndError(grpc.StatusCode.DEADLINE_EXCEEDED, "no registration came") from None
        _check_protocol_version(data)
        registration = _parse(data)
        if not isinstance(registration, Registration):
            raise _StreamEndError(grpc.StatusCode.INVALID_ARGUMENT, "the first message has to be a registration")
        result = self._loop.register(registration)
        if isinstance(result, Refusal):
            raise _StreamEndError(_REFUSAL_CODES[result], f"{registration.name}: {result.value}")
        return result

    @staticmethod
    async def _receive(context: Context) -> bytes:
        data = await context.read()
        if not isinstance(data, bytes):
            raise _StreamEndError(None, "the sidecar ended the stream")
        return data

    async def _read(self, stream: StreamId, context: Context) -> NoReturn:
        while True:
            message = _parse(await self._receive(context))
            try:
                self._loop.receive(stream, message)
            except DecodeError as error:
                raise _StreamEndError(grpc.StatusCode.INVALID_ARGUMENT, str(error)) from error

    @staticmethod
    async def _write(mailbox: Mailbox, context: Context) -> NoReturn:
        while True:
            message = await mailbox.get()
            if isinstance(message, CloseReason):
                raise _StreamEndError(_CLOSE_CODES[message], message.value)
            await context.write(control_message_to_proto(message))


def _parse(data: bytes) -> SidecarMessage:
    try:
        return parse_sidecar_message(data)
    except DecodeError as error:
        raise _StreamEndError(grpc.StatusCode.INVALID_ARGUMENT, str(error)) from error


def _check_protocol_version(data: bytes) -> None:
    """Before all else: what another version says may have another meaning."""
    try:
        message = control_pb2.SidecarMessage.FromString(data)
    except ProtobufDecodeError:
        return
    version = message.register.protocol_version
    if message.HasField("register") and version != PROTOCOL_VERSION:
        raise _StreamEndError(
            grpc.StatusCode.FAILED_PRECONDITION,
            f"protocol version {version} is not {PROTOCOL_VERSION}, which this control plane speaks",
        )
