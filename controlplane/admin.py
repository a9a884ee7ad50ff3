"""The gRPC side of `Admin`: what the operator asks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import grpc

from controlplane.core.explanation import UnknownNameError
from protos.convert import explain_request_from_proto, explanation_to_proto, status_to_proto
from protos.errors import DecodeError
from protos.plr.v1 import admin_pb2, admin_pb2_grpc

if TYPE_CHECKING:
    from typing import Any

    from controlplane.loop import ControlLoop

SERVICE_NAME = admin_pb2.DESCRIPTOR.services_by_name["Admin"].full_name


class AdminService(admin_pb2_grpc.AdminServicer):
    """Serves `Admin`."""

    def __init__(self, loop: ControlLoop) -> None:
        self._loop = loop

    async def GetStatus(self, request: admin_pb2.GetStatusRequest, context: Any) -> admin_pb2.GetStatusResponse:
        """Every registered sidecar and how far it follows."""
        return status_to_proto(self._loop.status(), self._loop.revocations)

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
