"""The gRPC side of `Admin`: what the operator asks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from protos.convert import status_to_proto
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
        return status_to_proto(self._loop.status())
