"""Cloud: the client of one local server, with the executions that wait for its answers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from sidecar.ros.errors import RosBridgeError
from sidecar.ros.request_window import RequestWindow
from sidecar.ros.ros_loop import service_qos
from sidecar.ros.types import serialize

if TYPE_CHECKING:
    from collections.abc import Callable

    from protos.model import ServiceName
    from sidecar.core.events import ExecutionId
    from sidecar.ros.types import ServiceType

TAKEN_AT_ONCE = 32
"""Answers taken from one server before the others have their turn."""


@dataclass(slots=True)
class Execution:
    """One request on its way through a local server."""

    id: ExecutionId
    request: Any
    arrived_at: float
    expires_at: float
    number: int | None = None
    """rmw's sequence number, once it is at the server."""
    abandoned: bool = False


class ServiceRunner:
    """Sends requests to one local server and hands its answers, as bytes, to `on_answer`."""

    def __init__(
        self,
        node: Any,
        name: ServiceName,
        service_type: ServiceType,
        on_answer: Callable[[ServiceRunner, Execution, bytes | RosBridgeError, float], None],
        on_stray_answer: Callable[[ServiceRunner], None],
        on_expired: Callable[[ServiceRunner, Execution], None],
    ) -> None:
        self.name = name
        self.type = service_type
        self._node = node
        self._on_answer = on_answer
        self._on_stray_answer = on_stray_answer
        self._on_expired = on_expired
        self._at_server: dict[int, Execution] = {}
        """By rmw's sequence number."""
        self.window: RequestWindow[Execution] = RequestWindow()
        self.endpoints: frozenset[bytes] = frozenset()
        """DDS ids of the server, to tell a restarted one from the old one."""
        try:
            self._client = node.create_client(service_type.service, name, qos_profile=service_qos())
        # rclpy validates names with exceptions of several unrelated classes.
        except Exception as error:
            raise RosBridgeError(f"rmw refuses a client of {name}, type {service_type.name}: {error}") from error

    @property
    def handle(self) -> Any:
        """rclpy's handle."""
        return self._client.handle

    @property
    def pending(self) -> int:
        """Executions at the server or waiting for it."""
        return len(self._at_server) + len(self.window.waiting)

    def is_matched(self) -> bool:
        """True once requests reach the server: before, rmw would drop them without a word."""
        return bool(self._client.handle.service_server_is_available())

    def add(self, execution: Execution, now: float) -> bool:
        """Send `execution` now, or as soon as the server has room; return False when it has to wait."""
        self.window.waiting.append(execution)
        self.release(now)
        return not self.window.waiting

    def release(self, now: float) -> None:
        """Send what may be sent now."""
        for execution in self.window.release(now):
            if execution.abandoned:
                continue
            if execution.expires_at <= now:
                self._on_expired(self, execution)
                continue
            number = self._client.handle.send_request(execution.request)
            execution.request = None  # it may be a large image, and is not needed again
            execution.number = number
            self._at_server[number] = execution
            self.window.sent(number, now)

    def take(self, now: float) -> None:
        """Take the answers that have arrived."""
        response_type = self.type.response
        for _ in range(TAKEN_AT_ONCE):
            header, response = self._client.handle.take_response(response_type)
            if header is None:
                break
            number = header.request_id.sequence_number
            self.window.answered(number, now)
            execution = self._at_server.pop(number, None)
            if execution is None:
                self._on_stray_answer(self)
                continue
            try:
                payload: bytes | RosBridgeError = serialize(response, response_type)
            except RosBridgeError as error:
                payload = error
            self._on_answer(self, execution, payload, now)
        self.release(now)

    def abandon(self, execution: Execution) -> None:
        """Forget `execution`; an answer to it is stray from now on."""
        execution.abandoned = True
        if execution.number is not None:
            self._at_server.pop(execution.number, None)

    def take_back(self) -> tuple[list[Execution], list[Execution]]:
        """Forget everything; return (executions that may have run, executions that certainly have not)."""
        sent = list(self._at_server.values())
        unsent = [execution for execution in self.window.waiting if not execution.abandoned]
        self._at_server.clear()
        self.window = RequestWindow()
        return sent, unsent

    def close(self) -> None:
        """Destroy the client."""
        self._node.destroy_client(self._client)
