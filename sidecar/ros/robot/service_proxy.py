"""Offers one service on a robot in place of its server in the cloud."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from plr.sidecar.ros.errors import RosBridgeError
from plr.sidecar.ros.rcl import Message, RmwRequestId, send_response, take_request
from plr.sidecar.ros.ros_loop import service_qos

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.protos.model.ids import ServiceName
    from plr.sidecar.ros.types import ServiceType

QUEUE_DEPTH = 1024
"""Requests that rmw keeps until the loop takes them; with the default of 10, some of 100 sent at once are lost."""
TAKEN_AT_ONCE = 32
"""Requests taken from one service before the next has its turn."""


class ServiceProxy:
    """A ROS service that takes requests as bytes, with rmw's header to answer them by."""

    def __init__(self, node: Any, name: ServiceName, service_type: ServiceType) -> None:
        """Create the service; raise RosBridgeError if rmw refuses."""
        self.name = name
        self.type = service_type
        self.open = True
        self._node = node
        try:
            self._service = node.create_service(
                service_type.service, name, _unused, qos_profile=service_qos(QUEUE_DEPTH)
            )
        # rclpy validates names with exceptions of several unrelated classes.
        except Exception as error:
            raise RosBridgeError(f"rmw refuses service {name} of type {service_type.name}: {error}") from error
        self._pointer: int = self._service.handle.pointer

    @property
    def handle(self) -> Any:
        """rclpy's handle."""
        return self._service.handle

    def take(self) -> Iterator[tuple[RmwRequestId, bytes] | RosBridgeError]:
        """Yield the requests that have arrived, a limited number at a time; for one that is unreadable, the error."""
        for _ in range(TAKEN_AT_ONCE):
            try:
                taken = take_request(self._pointer, self.type.request)
            except RosBridgeError as error:
                yield error
                continue
            if taken is None:
                return
            yield taken

    def parse_answer(self, payload: bytes | memoryview) -> Message:
        """Return the response in `payload`, or raise RosBridgeError."""
        return self.type.response.deserialize(payload)

    def answer(self, request_id: RmwRequestId, response: Message) -> None:
        """Answer the request with this rmw id, or raise RosBridgeError; see `rcl.send_response`."""
        send_response(self._pointer, request_id, response)

    def close(self) -> int:
        """Withdraw the service; return how many requests waited there unseen."""
        self.open = False
        unseen = 0
        while take_request(self._pointer, self.type.request) is not None:
            unseen += 1
        self._pointer = 0  # rcl refuses a null pointer, and would crash on the old one
        self._node.destroy_service(self._service)
        return unseen


def _unused(_request: Any, response: Any) -> Any:
    """Satisfy rclpy, which requires a callback; the loop takes requests itself."""
    return response
