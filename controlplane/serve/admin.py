"""Serves `Admin` over gRPC: answers the operator's questions.

Answers about the fleet are computed, encoded and sent in turns of the loop (`Turns`). An undivided message is the
concatenation of its encoded parts: a repeated field of protobuf may be cut between any two elements.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, NoReturn

import grpc

from plr.controlplane.core.explain.explanation import UnknownNameError
from plr.protos.base.errors import DecodeError
from plr.protos.convert import (
    departed_to_proto,
    event_query_from_proto,
    event_to_proto,
    explain_request_from_proto,
    explanation_to_proto,
    log_state_to_proto,
    pairs_to_proto,
    status_query_from_proto,
    status_to_proto,
)
from plr.protos.model.status import StatusQuery
from plr.protos.plr.v1 import admin_pb2

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from plr.controlplane.loop import ControlLoop
    from plr.protos.model.explanation import PairExplanation

SERVICE_NAME = admin_pb2.DESCRIPTOR.services_by_name["Admin"].full_name

STATUS_TURNS = 3.0
"""Length of a status turn in usual turns: somebody waits for the whole answer, and the loop and the solver still run
between two turns."""

DEPARTED_TOLD = 256
"""Departed sidecars in one status, the most recent ones; `plr events` shows the others."""

EVENTS_TOLD = 10
"""Events in one status, the most recent ones."""

MAX_STATUS_BYTES = 16 << 20
"""Longest GetStatus answer: four times what 4,096 robots with 15 paths each take, and four times gRPC's default limit
for a client."""


class AdminService:
    """Serves `Admin`."""

    def __init__(self, loop: ControlLoop) -> None:
        self._loop = loop

    def add_to(self, server: grpc.aio.Server) -> None:
        """Serve on this server."""
        handlers: dict[str, grpc.RpcMethodHandler[Any, Any]] = {
            "GetStatus": grpc.unary_unary_rpc_method_handler(self.get_status, admin_pb2.GetStatusRequest.FromString),
            "StreamStatus": grpc.unary_stream_rpc_method_handler(
                self.stream_status, admin_pb2.StreamStatusRequest.FromString
            ),
            "Explain": grpc.unary_unary_rpc_method_handler(self.explain, admin_pb2.ExplainRequest.FromString),
            "ListEvents": grpc.unary_unary_rpc_method_handler(self.list_events, admin_pb2.ListEventsRequest.FromString),
        }
        server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(SERVICE_NAME, handlers),))

    async def get_status(self, request: admin_pb2.GetStatusRequest, context: Any) -> bytes:
        """Return all registered sidecars and how far each follows, the departed and the last events, in one message."""
        answer = bytearray()
        async for part in self._status(StatusQuery()):
            answer += part
            if len(answer) > MAX_STATUS_BYTES:
                text = "the fleet is too large for one message: use a newer plr, which accepts it in parts"
                await _abort(context, grpc.StatusCode.RESOURCE_EXHAUSTED, text)
        return bytes(answer)

    async def stream_status(self, request: admin_pb2.StreamStatusRequest, context: Any) -> AsyncIterator[bytes]:
        """Yield the same in parts."""
        try:
            query = status_query_from_proto(request)
        except DecodeError as error:
            await _abort(context, grpc.StatusCode.INVALID_ARGUMENT, str(error))
        async for part in self._status(query):
            yield part

    async def _status(self, query: StatusQuery) -> AsyncIterator[bytes]:
        loop = self._loop
        rest = status_to_proto((), loop.revocations)
        rest.departed_left_out = max(0, len(loop.departed) - DEPARTED_TOLD)
        rest.events.extend(map(event_to_proto, loop.events.last(EVENTS_TOLD)))
        rest.log.CopyFrom(log_state_to_proto(loop.events.state))
        yield rest.SerializeToString()
        departed = loop.departed.told(loop.now(), DEPARTED_TOLD)
        async for gone in loop.turns.each(departed, departed_to_proto):
            yield admin_pb2.GetStatusResponse(departed=gone).SerializeToString()
        names = query.names or loop.names()
        abridged = 0 < query.detailed_at_most < len(names)
        async for found in loop.turns.each(names, partial(loop.status, abridged=abridged), STATUS_TURNS):
            yield b"".join(found)

    async def explain(self, request: admin_pb2.ExplainRequest, context: Any) -> bytes:
        """Explain why a robot's requests for a service go where they go."""
        try:
            robot, service = explain_request_from_proto(request)
            head, pairs = self._loop.explain(robot, service)
        except DecodeError as error:
            await _abort(context, grpc.StatusCode.INVALID_ARGUMENT, str(error))
        except UnknownNameError as error:
            await _abort(context, grpc.StatusCode.NOT_FOUND, str(error))
        answer = bytearray(explanation_to_proto(head).SerializeToString())
        async for parts in self._loop.turns.each(pairs, _encoded_pair):
            answer += b"".join(parts)
        return bytes(answer)

    async def list_events(self, request: admin_pb2.ListEventsRequest, context: Any) -> bytes:
        """Return what happened in the fleet."""
        try:
            query = event_query_from_proto(request)
        except DecodeError as error:
            await _abort(context, grpc.StatusCode.INVALID_ARGUMENT, str(error))
        found, left_out = self._loop.events.find(query)
        log = log_state_to_proto(self._loop.events.state)
        answer = bytearray(admin_pb2.ListEventsResponse(left_out=left_out, log=log).SerializeToString())
        async for events in self._loop.turns.each(found, event_to_proto):
            answer += admin_pb2.ListEventsResponse(events=events).SerializeToString()
        return bytes(answer)


def _encoded_pair(pair: PairExplanation | None) -> bytes:
    """Return a pair as an encoded part of an ExplainResponse."""
    return b"" if pair is None else pairs_to_proto((pair,)).SerializeToString()


async def _abort(context: Any, code: grpc.StatusCode, text: str) -> NoReturn:
    await context.abort(code, text)
    raise AssertionError("abort raises")
