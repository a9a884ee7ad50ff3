"""Cloud side: takes robots' requests from their arrival to their answers (paper, figure "Workflow Diagram", request
steps 7 to 9). `executions.py` decides which of them run."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from plr.sidecar.core.base.slices import in_groups
from plr.sidecar.core.base.values import RejectReason
from plr.sidecar.core.cloud.answers import Answers
from plr.sidecar.core.cloud.executions import ExecutionTable, Reply, ReplyTo
from plr.sidecar.core.cloud.forbidden_calls import ForbiddenCalls
from plr.sidecar.core.rules.service_rule import MAX_LIFETIME_S, Rules
from plr.sidecar.core.seam.application import ExecuteRequest

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable

    from plr.protos.model.ids import NodeName, ServiceName
    from plr.protos.model.members import ServiceOffer
    from plr.sidecar.core.base.slices import Backlog, Step
    from plr.sidecar.core.base.values import ExecutionId, PathId, RequestId
    from plr.sidecar.core.seam.application import ApplicationEvent
    from plr.sidecar.core.seam.stats import EngineStats
    from plr.sidecar.core.transfer.outbox import Outbox
    from plr.sidecar.core.transfer.routes import Routes
    from plr.sidecar.core.wire.messages import CancelMessage, RequestMessage


@dataclass(frozen=True, slots=True)
class ServingParts:
    """What the serving side works with."""

    rules: Rules
    routes: Routes
    outbox: Outbox
    stats: EngineStats
    emit: Callable[[ApplicationEvent], None]
    may_call: Callable[[NodeName, ServiceName], bool]
    """Return whether the access policy lets a robot call a service here."""
    backlog: Backlog


class Serving:
    """Hands requests to the application and sends its answers."""

    def __init__(self, parts: ServingParts) -> None:
        self._parts = parts
        self._offers: dict[ServiceName, ServiceOffer] = {}
        self._draining = False
        self._forbidden = ForbiddenCalls()
        self.executions = ExecutionTable(parts.stats)
        self.answers = Answers(parts.rules, parts.routes, parts.outbox, parts.stats, parts.backlog)

    @property
    def running(self) -> int:
        """Return the number of requests being worked on."""
        return self.executions.running

    def awaited(self, robots: Collection[NodeName]) -> int:
        """Return the number of these robots' awaited requests that run here or whose answers wait for room."""
        return self.executions.awaited(robots) + self.answers.unsent(robots)

    @property
    def offers(self) -> tuple[ServiceOffer, ...]:
        """Return what can be run here."""
        return tuple(self._offers.values())

    def set_offers(self, offers: Iterable[ServiceOffer]) -> None:
        """Replace the services that local servers offer right now."""
        self._offers = {offer.name: offer for offer in offers}

    def drain(self) -> None:
        """Take no new requests; those in flight go on."""
        self._draining = True

    # -- the robots -----------------------------------------------------------------------------------------------

    def on_request(self, path: PathId, message: RequestMessage, now: float) -> None:
        """Take a copy of a request that arrived."""
        refusal = self._refusal(path.peer, message, now)
        if refusal and not self.executions.knows(path.peer, message.request_id):
            reply_to = ReplyTo(path, message.copy)
            self.answers.send([self.executions.refuse_unseen(reply_to, message, *refusal, now)], now)
            return
        rule = self._parts.rules.find(message.service)
        patience_s = rule.lifetime_s if rule else MAX_LIFETIME_S
        outcome = self.executions.on_request(path, message, now, patience_s=patience_s)
        if isinstance(outcome, ExecuteRequest):
            self._parts.emit(outcome)
        elif isinstance(outcome, Reply):
            self.answers.send([outcome], now)

    def _refusal(self, robot: NodeName, message: RequestMessage, now: float) -> tuple[RejectReason, str] | None:
        if not self._parts.may_call(robot, message.service):
            notice = self._forbidden.note(robot, message.service, now)
            if notice is not None:
                self._parts.emit(notice)
            # First of all: a robot that may not call a service does not learn whether it is offered here either.
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
        """Send no more answers to a robot that has one, and do not start its request if it does not run yet."""
        event = self.executions.cancel(robot, message.request_id, now)
        if event is not None:
            self._parts.emit(event)
        self.answers.drop(robot, message.request_id)

    def on_room(self, now: float) -> None:
        """Send what waited for room, since less is under way than before."""
        self.answers.on_room(now)

    def on_robot_gone(self, robot: NodeName) -> list[Step]:
        """Stop sending to a robot, for a while at least; return the steps left to do."""
        return self.answers.drop_robot(robot)

    def on_session_over(self, robot: NodeName) -> list[Step]:
        """Return the steps that call off what servers have not got yet from a robot that said goodbye or restarted."""
        return in_groups(partial(self._call_off, robot), self.executions.of_robot(robot))

    def _call_off(self, robot: NodeName, request: RequestId) -> None:
        event = self.executions.call_off(robot, request)
        if event is not None:
            self._parts.emit(event)

    # -- the application ------------------------------------------------------------------------------------------

    def complete(self, execution: ExecutionId, payload: bytes, processing_s: float, now: float) -> None:
        """Send the local server's answer."""
        self.answers.send(self.executions.complete(execution, payload, processing_s, now), now)

    def refuse(self, execution: ExecutionId, reason: RejectReason, detail: str, now: float) -> None:
        """Send the refusal of a request that was not or will not be answered."""
        self.answers.send(self.executions.refuse(execution, reason, detail, now), now)

    # -- time -----------------------------------------------------------------------------------------------------

    def next_timer(self) -> float | None:
        """Return when to call `handle_timer`."""
        timers = (self.executions.next_timer(), self.answers.next_timer())
        return min((timer for timer in timers if timer is not None), default=None)

    def handle_timer(self, now: float) -> None:
        """Give up what took too long to run or to be sent, as much of it as this turn has room for."""
        abandoned, replies = self.executions.handle_timer(now, self._parts.backlog)
        for event in abandoned:
            self._parts.emit(event)
        self.answers.send(replies, now)
        self.answers.handle_timer(now)
