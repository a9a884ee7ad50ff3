"""A local server that takes its requests one by one, behind the same window as a real one's (`sidecar/ros`)."""

from __future__ import annotations

from collections import deque
from itertools import count
from typing import TYPE_CHECKING

from plr.sidecar.core.base.values import ExecutionId, RejectReason, RequestId
from plr.sidecar.core.seam.application import AbandonExecution, ApplicationEvent, CancelExecution, ExecuteRequest
from plr.sidecar.ros.cloud.request_window import RequestWindow

if TYPE_CHECKING:
    from lab.simulated.mesh import Mesh, Node

QUEUE_DEPTH = 10
"""rmw's default."""


class SerialServer:
    """Runs a cloud's requests, each for `busy_s`."""

    def __init__(self, mesh: Mesh, node: Node, busy_s: float) -> None:
        self.mesh = mesh
        self.node = node
        self.busy_s = busy_s
        self.answer = b""
        """Sent after the request's own first bytes."""
        self.window: RequestWindow[ExecutionId] = RequestWindow()
        self.requests: dict[ExecutionId, ExecuteRequest] = {}
        self.expires_at: dict[ExecutionId, float] = {}
        self.ran = 0
        self._numbers = count(1)
        self._queue: deque[tuple[int, ExecutionId]] = deque()
        self._idle = True
        node.server = self.handle

    def handle(self, event: ApplicationEvent) -> None:
        now = self.mesh.now
        match event:
            case ExecuteRequest():
                self.requests[event.execution] = event
                self.expires_at[event.execution] = now + event.expires_s
                self.window.add(event.execution, event.priority, now + event.deadline_s, now + event.expires_s, now)
            case CancelExecution(execution=execution) | AbandonExecution(execution=execution):
                if self.window.holds(execution):
                    self.window.remove(execution)
                    self._forget(execution)
                    if isinstance(event, CancelExecution):
                        self.node.engine.cloud.refuse(execution, RejectReason.CANCELLED, "called off", now)
                    elif event.awaited:
                        self.node.engine.cloud.refuse(execution, RejectReason.OVERLOADED, "its time here is over", now)
        self._release()

    def _release(self) -> None:
        for execution in self.window.release(self.mesh.now):
            if self.expires_at[execution] <= self.mesh.now:
                self._forget(execution)
                self.node.engine.cloud.refuse(execution, RejectReason.OVERLOADED, "its time is over", self.mesh.now)
                continue
            number = next(self._numbers)
            self.window.sent(number, self.mesh.now)
            self._queue.append((number, execution))
            assert len(self._queue) <= QUEUE_DEPTH
        if self._idle and self._queue:
            self._idle = False
            number, execution = self._queue.popleft()
            self.mesh.at(self.busy_s, lambda: self._done(number, execution))

    def _forget(self, execution: ExecutionId) -> ExecuteRequest:
        del self.expires_at[execution]
        return self.requests.pop(execution)

    def _done(self, number: int, execution: ExecutionId) -> None:
        self._idle = True
        self.ran += 1
        payload = self._forget(execution).payload
        self.node.executed.append(RequestId(bytes(payload)))
        self.window.answered(number, self.mesh.now)
        self.node.engine.cloud.complete(execution, b"echo:" + payload[:100] + self.answer, self.busy_s, self.mesh.now)
        self._release()
        self.mesh.pump(self.node)
