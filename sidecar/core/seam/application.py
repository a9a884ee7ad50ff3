"""Defines the values that the data plane and the application side (the ROS bridge) exchange."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
    from plr.protos.model.mapping import Assignment
    from plr.sidecar.core.base.values import ExecutionId, Priority, RequestId


@dataclass(frozen=True, slots=True)
class OfferService:
    """A live server offers this service and the configuration allows it: offer it on the robot."""

    name: ServiceName
    type: str


@dataclass(frozen=True, slots=True)
class WithdrawService:
    """The last live server of this service is gone."""

    name: ServiceName
    reason: str


@dataclass(frozen=True, slots=True)
class CarriedService:
    """A service whose proxy exists in the robot's ROS graph now."""

    name: ServiceName
    fallback_up: bool | None = None
    """Whether its fallback on the robot itself can be called; None: it has none."""


@dataclass(frozen=True, slots=True)
class ResponseArrived:
    """A response to a request. `judge_answer` says whether it can be delivered; until then another one may come."""

    request_id: RequestId
    service: ServiceName
    copy: int
    """Which copy of the request was answered."""
    payload: bytes | memoryview = field(repr=False)
    """A view of its own buffer: a consumer that needs bytes copies them, which takes milliseconds for the largest."""
    server: NodeName
    interface: InterfaceName
    elapsed_s: float
    late: bool


@dataclass(frozen=True, slots=True)
class DeadlineMissed:
    """A request's deadline passed without a response; the request goes on until its lifetime ends.

    Not sent for a request that the application already has an answer to (`answered_locally`).
    """

    request_id: RequestId
    service: ServiceName
    deadline_s: float
    copies: tuple[Assignment, ...]


@dataclass(frozen=True, slots=True)
class Unreachable:
    """No path to any server of the request is up, and its service has a fallback. Sent once for each request."""

    request_id: RequestId
    service: ServiceName


@dataclass(frozen=True, slots=True)
class RequestFailed:
    """No response will come. `outcome` is a label of plr_requests_total: failed, rejected or late_dropped.

    For a request with `answered_locally` it is deadline_missed.
    """

    request_id: RequestId
    service: ServiceName
    outcome: str
    reason: str
    elapsed_s: float


@dataclass(frozen=True, slots=True)
class ExecuteRequest:
    """Run this request on the local server, once; answer with `complete` or `refuse`."""

    execution: ExecutionId
    service: ServiceName
    type: str
    payload: bytes | memoryview = field(repr=False)
    """A view of its own buffer: a consumer that needs bytes copies them, which takes milliseconds for the largest."""
    robot: NodeName
    priority: Priority
    deadline_s: float
    """Seconds from now after which the answer is late; 0 if it is late already."""
    expires_s: float
    """Seconds from now after which nobody waits for the answer."""


@dataclass(frozen=True, slots=True)
class AbandonExecution:
    """Forget this execution: the local server took too long, or nobody waits for it any more."""

    execution: ExecutionId
    robot: NodeName
    awaited: bool = False
    """Whether a robot still waits: refuse it, with a reason that says whether the local server got it."""


@dataclass(frozen=True, slots=True)
class CancelExecution:
    """Refuse this execution as CANCELLED unless the local server already has it: the robot has its answer."""

    execution: ExecutionId
    robot: NodeName


@dataclass(frozen=True, slots=True)
class CallsForbidden:
    """A robot asked for what it may not call, `count` times since the last such event; `service` is the latest."""

    robot: NodeName
    service: ServiceName
    """As the robot wrote it: any text."""
    count: int


ApplicationEvent = (
    OfferService
    | WithdrawService
    | ResponseArrived
    | DeadlineMissed
    | Unreachable
    | RequestFailed
    | ExecuteRequest
    | AbandonExecution
    | CancelExecution
    | CallsForbidden
)
