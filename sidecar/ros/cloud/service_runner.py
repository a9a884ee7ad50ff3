"""Runs requests on one local server in the cloud, and keeps the calls that wait for its answers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from plr.sidecar.ros.cloud.local_server import LocalServer
from plr.sidecar.ros.cloud.request_window import RequestWindow
from plr.sidecar.ros.errors import RosBridgeError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from plr.protos.model.ids import NodeName, ServiceName
    from plr.sidecar.core.base.values import ExecutionId, Priority
    from plr.sidecar.ros.graph.graph import NameOf
    from plr.sidecar.ros.rcl import Message
    from plr.sidecar.ros.types import ServiceType


@dataclass(slots=True, eq=False)
class PendingCall:
    """One request on its way through a local server."""

    id: ExecutionId
    robot: NodeName
    request: Message | None
    arrived_at: float
    priority: Priority
    deadline_at: float
    expires_at: float
    number: int | None = None
    """rmw's sequence number, once the request is at the server."""


class ServiceRunner:
    """Sends requests to one local server and takes its answers, as bytes."""

    def __init__(
        self,
        node: Any,
        name: ServiceName,
        service_type: ServiceType,
        alive_since: Callable[[ServiceRunner, float], bool],
        name_of: NameOf,
    ) -> None:
        """Take `alive_since`: whether the server has shown a sign of life, other than an answer, since then."""
        self.name = name
        self.type = service_type
        self._alive_since = partial(alive_since, self)
        self._at_server: dict[int, PendingCall] = {}
        """Calls at the server by rmw's sequence number."""
        self.window: RequestWindow[PendingCall] = RequestWindow(alive_since=self._alive_since)
        self._server = LocalServer(node, name, service_type, name_of)
        self._heard_at = 0.0
        """When the server answered last, or got a request while it had none."""

    @property
    def handle(self) -> Any:
        """rclpy's handle."""
        return self._server.handle

    @property
    def pending(self) -> int:
        """Number of calls at the server or waiting for it."""
        return len(self._at_server) + self.window.waiting

    @property
    def server(self) -> LocalServer:
        """The server that runs the requests."""
        return self._server

    @property
    def silent_since(self) -> float | None:
        """Start of the server's silence while it has something to answer, or None."""
        return self._heard_at if self._at_server else None

    def add(self, call: PendingCall, now: float) -> None:
        """Let `call` wait until `release` finds room for it at the server."""
        self.window.add(call, call.priority, call.deadline_at, call.expires_at, now, robot=call.robot)

    def release(self, now: float) -> list[tuple[PendingCall, str]]:
        """Send the calls that may go now; return those that cannot be sent, and why."""
        unsent: list[tuple[PendingCall, str]] = []
        for call in self.window.release(now):
            request, call.request = call.request, None  # it may be a large image, and is not needed again
            if request is None or call.expires_at <= now:
                unsent.append((call, "its time was over before the server had room for it"))
                continue
            try:
                number = self._server.send(request)
            except RosBridgeError as error:
                unsent.append((call, str(error)))
                continue
            if not self._at_server:
                self._heard_at = now
            call.number = number
            self._at_server[number] = call
            self.window.sent(number, now)
        return unsent

    def take(self, now: float) -> Iterator[tuple[PendingCall | None, bytes]]:
        """Yield the answers that have arrived, each with its call; None stands for one that is not awaited.

        There may be room then for waiting calls: see `release`.
        """
        for number, payload in self._server.take():
            self.window.answered(number, now)
            self._heard_at = now
            yield self._at_server.pop(number, None), payload

    def abandon(self, call: PendingCall) -> None:
        """Forget `call`; an answer to it will be stray."""
        if call.number is not None:
            self._at_server.pop(call.number, None)
            self.window.given_up(call.number)
        else:
            self.window.remove(call)

    def take_back(self) -> tuple[list[PendingCall], list[PendingCall]]:
        """Forget everything; return (calls that may have run, calls that certainly have not)."""
        sent = list(self._at_server.values())
        self._at_server.clear()
        unsent = self.take_back_unsent()
        self.window = RequestWindow(alive_since=self._alive_since)
        return sent, unsent

    def take_back_unsent(self) -> list[PendingCall]:
        """Forget and return the waiting calls, which certainly have not run; those at the server stay."""
        return self.window.take_all()

    def close(self) -> None:
        """Destroy the client."""
        self._server.close()
