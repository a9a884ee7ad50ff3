"""The gRPC side of `Admin`: what the operator asks."""

from __future__ import annotations

import asyncio
from itertools import islice
from typing import TYPE_CHECKING

import grpc

from controlplane.core.explanation import UnknownNameError
from protos.convert import (
    departed_to_proto,
    event_query_from_proto,
    event_to_proto,
    explain_request_from_proto,
    explanation_to_proto,
    log_state_to_proto,
    status_to_proto,
)
from protos.errors import DecodeError
from protos.plr.v1 import admin_pb2, admin_pb2_grpc

if TYPE_CHECKING:
    from typing import Any

    from controlplane.loop import ControlLoop

SERVICE_NAME = admin_pb2.DESCRIPTOR.services_by_name["Admin"].full_name

DEPARTED_TOLD = 256
"""Sidecars that are gone in one status, those that went last; `plr events` tells of the others."""

EVENTS_TOLD = 10
"""Events in one status, the last ones."""

EVENTS_A_TURN = 256
"""Events encoded in one go, some 2 ms: meanwhile the streams wait."""


class AdminService(admin_pb2_grpc.AdminServicer):
    """Serves `Admin`."""

    def __init__(self, loop: ControlLoop) -> None:
        self._loop = loop

    async def GetStatus(self, request: admin_pb2.GetStatusRequest, context: Any) -> admin_pb2.GetStatusResponse:
        """Every registered sidecar and how far it follows, who is gone, and what happened last."""
        answer = status_to_proto(self._loop.status(), self._loop.revocations)
        departed = self._loop.departed
        answer.departed.extend(map(departed_to_proto, departed.told(self._loop.now(), DEPARTED_TOLD)))
        answer.departed_left_out = len(departed) - len(answer.departed)
        answer.events.extend(map(event_to_proto, self._loop.events.last(EVENTS_TOLD)))
        answer.log.CopyFrom(log_state_to_proto(self._loop.events.state))
        return answer

    async def Explain(self, request: admin_pb2.ExplainRequest, context: Any) -> admin_pb2.ExplainResponse:
        """Why a robot's requests for a service go where they go."""
        try:
            robot, service = explain_request_from_proto(request)
            return explanation_to_proto(self._loop.explain(robot, service))
        except DecodeError as error:
            await context.abort(grpc.StatusCode.INVALID_ARGUMENT, str(error))
        except UnknownNameError as error:
            await context.abort(grpc.StatusCode.NOT_FOUND, str(error))
        raise AssertionError("abort raises")

    async def ListEvents(self, request: admin_pb2.ListEventsRequest, context: Any) -> admin_pb2.ListEventsResponse:
        """What happened in the fleet."""
        try:
            query = event_query_from_proto(request)
        except DecodeError as error:
            await context.abort(grpc.StatusCode.INVALID_ARGUMENT, str(error))
        found, left_out = self._loop.events.find(query)
        answer = admin_pb2.ListEventsResponse(left_out=left_out, log=log_state_to_proto(self._loop.events.state))
        rest = iter(found)
        while turn := list(islice(rest, EVENTS_A_TURN)):
            answer.events.extend(map(event_to_proto, turn))
            await asyncio.sleep(0)
        return answer
