"""One server of the local graph, as its client sees it: requests go in and answers come out, each with rmw's number."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sidecar.ros import graph
from sidecar.ros.errors import RosBridgeError
from sidecar.ros.rcl import Message, send_request, take_response
from sidecar.ros.ros_loop import service_qos
from sidecar.ros.server_capacity import MOST_AT_ONCE

if TYPE_CHECKING:
    from collections.abc import Iterator

    from protos.model import ServiceName
    from sidecar.ros.types import ServiceType

TAKEN_AT_ONCE = 32
"""Answers taken from one server before the others have their turn."""


class LocalServer:
    """A client of the service `name`."""

    def __init__(self, node: Any, name: ServiceName, service_type: ServiceType) -> None:
        """Raises RosBridgeError: rmw refuses."""
        self.name = name
        self.type = service_type
        self._node = node
        try:
            self._client = node.create_client(service_type.service, name, qos_profile=service_qos(MOST_AT_ONCE))
        # rclpy validates names with exceptions of several unrelated classes.
        except Exception as error:
            raise RosBridgeError(f"rmw refuses a client of {name}, type {service_type.name}: {error}") from error
        self._pointer: int = self._client.handle.pointer
        self._endpoints = graph.server_endpoints(node, name)
        """DDS ids of the server, to tell a restarted one from the old one."""

    @property
    def handle(self) -> Any:
        """rclpy's handle."""
        return self._client.handle

    def is_matched(self) -> bool:
        """True once requests reach the server: before, rmw would drop them without a word."""
        return bool(self._client.handle.service_server_is_available())

    def was_replaced(self) -> bool:
        """Whether, since the last call, the server went and another came, which will not answer what it was asked."""
        endpoints = graph.server_endpoints(self._node, self.name)
        replaced = bool(endpoints and self._endpoints and not endpoints & self._endpoints)
        self._endpoints = endpoints or self._endpoints
        return replaced

    def send(self, request: Message) -> int:
        """Send a request; returns its number. Raises RosBridgeError."""
        return send_request(self._pointer, request)

    def take(self) -> Iterator[tuple[int, bytes]]:
        """Yield the answers that have arrived, some of many: (number of the request, bytes)."""
        for _ in range(TAKEN_AT_ONCE):
            taken = take_response(self._pointer, self.type.response)
            if taken is None:
                return
            yield taken

    def close(self) -> None:
        """Destroy the client."""
        self._pointer = 0  # rcl refuses a null pointer, and would crash on the old one
        self._node.destroy_client(self._client)
