"""Cloud side: robots' requests from their arrival to their answers (paper, figure "Workflow Diagram", request steps 7
to 9). Which of them run is `dedup.py`'s."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from sidecar.core.dedup import ExecutionTable, Reply, Waiter
from sidecar.core.events import ExecuteRequest, RejectReason
from sidecar.core.forbidden import ForbiddenCalls
from sidecar.core.messages import encode_message
from sidecar.core.path_id import PathId, PathState
from sidecar.core.rules import MAX_LIFETIME_S, Rules

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable

    from protos.model import NodeName, ServiceName, ServiceOffer
    from sidecar.core.events import ApplicationEvent, ExecutionId
    from sidecar.core.messages import CancelMessage, RequestMessage
    from sidecar.core.outbox import Outbox
    from sidecar.core.routes import Routes
    from sidecar.core.stats import EngineStats


@dataclass(frozen=True, slots=True)
class ServingParts:
    """What the serving side works with."""

    rules: Rules
    routes: Routes
    outbox: Outbox
    stats: EngineStats
    emit: Callable[[ApplicationEvent], None]
    may_call: Callable[[NodeName, ServiceName], bool]
    """Whether the access policy lets a robot call a service here."""


class Serving:
    """Hands requests to the application and sends its answers."""

    def __init__(self, parts: ServingParts) -> None:
        self._parts = parts
        self._offers: dict[ServiceName, ServiceOffer] = {}
        self._draining = False
        self._forbidden = ForbiddenCalls()
        self.executions = ExecutionTable(parts.stats)

    @property
    def running(self) -> int:
        """How many requests are being worked on."""
        return self.executions.running

    def awaited(self, robots: Collection[NodeName]) -> int:
        """How many of those one of these robots still waits for."""
        return self.executions.awaited(robots)

    @property
    def offers(self) -> tuple[ServiceOffer, ...]:
        """What can be run here."""
        return tuple(self._offers.values())

    def set_offers(self, offers: Iterable[ServiceOffer]) -> None:
        """The services that local servers offer right now."""
        self._offers = {offer.name: offer for offer in offers}

    def drain(self) -> None:
        """Take no new requests; those in flight go on."""
        self._draining = True

    # -- the robots -----------------------------------------------------------------------------------------------

    def on_request(self, path: PathId, message: RequestMessage, now: float) -> None:
        """A copy of a request arrived."""
        refusal = self._refusal(path.peer, message, now)
        if refusal and not self.executions.knows(message.request_id):
            self._reply([self.executions.refuse_unseen(Waiter(path, message.copy), message, *refusal, now)])
            return
        rule = self._parts.rules.find(message.service)
        patience_s = rule.lifetime_s if rule else MAX_LIFETIME_S
        outcome = self.executions.on_request(path, message, now, patience_s=patience_s)
        if isinstance(outcome, ExecuteRequest):
            self._parts.emit(outcome)
        elif isinstance(outcome, Reply):
            self._reply([outcome])

    def _refusal(self, robot: NodeName, message: RequestMessage, now: float) -> tuple[RejectReason, str] | None:
        if not self._parts.may_call(robot, message.service):
            notice = self._forbidden.note(robot, message.service, now)
            if notice is not None:
                self._parts.emit(notice)
            # Before all else: who may not call a service does not learn either whether it is offered here.
            return RejectReason.FORBIDDEN, f"the access policy does not let {robot} call {message.service} here"
        offer = self._offers.get(message.service)
        if offer is None:
            return RejectReason.NOT_OFFERED, f"no server for {message.service}"
        if self._draining:
            return RejectReason.DRAINING, "the sidecar is going away"
        if offer.type != message.type:
            return RejectReason.WRONG_TYPE, f"{message.service} has type {offer.type}, not {message.type}"
        return None

    def on_cancel(self, robot: NodeName, message: CancelMessage, now: float) -> None:
        """The robot has its answer: send nothing more of ours, and run the request only if it runs already."""
        event = self.executions.cancel(robot, message.request_id, now)
        if event is not None:
            self._parts.emit(event)
        self._parts.outbox.drop_answers(robot, message.request_id)

    def on_session_over(self, robot: NodeName) -> None:
        """The robot said goodbye or restarted: what its servers have not got yet needs not run."""
        for event in self.executions.cancel_all(robot):
            self._parts.emit(event)

    # -- the application ------------------------------------------------------------------------------------------

    def complete(self, execution: ExecutionId, payload: bytes, processing_s: float, now: float) -> None:
        """The local server answered."""
        self._reply(self.executions.complete(execution, payload, processing_s, now))

    def refuse(self, execution: ExecutionId, reason: RejectReason, detail: str, now: float) -> None:
        """The request was not or will not be answered."""
        self._reply(self.executions.refuse(execution, reason, detail, now))

    def _reply(self, replies: list[Reply]) -> None:
        routes = self._parts.routes
        for reply in replies:
            rule = self._parts.rules.find(reply.service)
            path = reply.waiter.path
            if routes.state(path) is PathState.DOWN:
                path = routes.best_to(path.peer) or path
            self._parts.outbox.send(
                path,
                encode_message(reply.message),
                priority=reply.priority,
                deadline=reply.deadline,
                expires=reply.expires,
                fec=rule.fec if rule else None,
                answers=reply.message.request_id,
            )

    # -- time -----------------------------------------------------------------------------------------------------

    def next_timer(self) -> float | None:
        """When `handle_timer` is wanted."""
        return self.executions.next_timer()

    def handle_timer(self, now: float) -> None:
        """Give up what took too long."""
        abandoned, replies = self.executions.handle_timer(now)
        for event in abandoned:
            self._parts.emit(event)
        self._reply(replies)
