"""Cloud's role: takes robots' requests from their arrival to their answers (paper, figure "Workflow Diagram", request
steps 7 to 9). `executions.py` decides which of them run."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from plr.protos.model.members import MAX_PEERS
from plr.protos.model.report import Report
from plr.sidecar.core.base.slices import in_groups
from plr.sidecar.core.base.values import RejectReason
from plr.sidecar.core.cloud.answers import Answers
from plr.sidecar.core.cloud.executions import ExecutionTable, Reply, ReplyTo
from plr.sidecar.core.cloud.forbidden_calls import ForbiddenCalls
from plr.sidecar.core.rules.service_rule import MAX_LIFETIME_S
from plr.sidecar.core.seam.application import ExecuteRequest
from plr.sidecar.core.wire.messages import CancelMessage, RequestMessage

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from plr.protos.model.ids import InterfaceName, NodeName, ServiceName, SessionId
    from plr.protos.model.mapping import MappingSet, ServiceMapping
    from plr.protos.model.members import ServiceOffer, ServiceUse
    from plr.sidecar.core.base.report_scope import ReportScope
    from plr.sidecar.core.base.values import ExecutionId, PathId, PathState, RequestId
    from plr.sidecar.core.message.outbound import OutboundMessage
    from plr.sidecar.core.seam.links import PathMeasured
    from plr.sidecar.core.transfer.engine_parts import EngineParts
    from plr.sidecar.core.wire.messages import ServiceMessage


class CloudRole:
    """Hands requests to the application and sends its answers."""

    def __init__(self, parts: EngineParts) -> None:
        self._parts = parts
        self._offers: dict[ServiceName, ServiceOffer] = {}
        self._draining = False
        self._services_changed = False
        self._away: dict[NodeName, SessionId] = {}
        """Robots that fell silent, are no peers any more, and may come back with this session."""
        self._forbidden = ForbiddenCalls()
        self.executions = ExecutionTable(parts.stats)
        self.answers = Answers(parts.rules, parts.routes, parts.outbox, parts.stats, parts.backlog)

    # -- the application ------------------------------------------------------------------------------------------

    def set_offers(self, offers: Iterable[ServiceOffer]) -> None:
        """Replace the services that local servers offer right now."""
        self._offers = {offer.name: offer for offer in offers}
        self._services_changed = True

    def complete(self, execution: ExecutionId, payload: bytes, processing_s: float, now: float) -> None:
        """Send the local server's answer."""
        self.answers.send(self.executions.complete(execution, payload, processing_s, now), now)

    def refuse(self, execution: ExecutionId, reason: RejectReason, detail: str, now: float) -> None:
        """Send the refusal of a request that was not or will not be answered."""
        self.answers.send(self.executions.refuse(execution, reason, detail, now), now)

    # -- the program and the control plane ------------------------------------------------------------------------

    def drain(self) -> None:
        """Take no new requests; those in flight go on."""
        self._draining = True

    def awaited(self, peers: Collection[NodeName]) -> int:
        """Return the number of these robots' awaited requests that run here or whose answers wait for room."""
        return self.executions.awaited(peers) + self.answers.unsent(peers)

    def offers(self) -> tuple[ServiceOffer, ...]:
        """Return what can be run here."""
        return tuple(self._offers.values())

    def uses(self) -> tuple[ServiceUse, ...]:
        """Return nothing: a cloud carries no services."""
        return ()

    def take_services_changed(self) -> bool:
        """Return whether `offers` may have changed since the last call."""
        changed, self._services_changed = self._services_changed, False
        return changed

    @property
    def offer_conflicts(self) -> frozenset[tuple[ServiceName, NodeName, str]]:
        """Return nothing: a cloud chooses no servers."""
        return frozenset()

    def apply_mapping(self, _mapping: MappingSet, _interfaces: Collection[InterfaceName]) -> str | None:
        """Refuse a mapping: it says where requests go, and a cloud sends none."""
        return "a cloud takes no mapping"

    @property
    def service_mappings(self) -> tuple[ServiceMapping, ...]:
        """Return nothing: a cloud has no mapping."""
        return ()

    def take_urgency(self) -> ReportScope | None:
        """Return None: a cloud reports nothing."""
        return None

    def take_report(self, _now: float, _scope: ReportScope) -> Report:
        """Return an empty report: robots measure the paths between them and a cloud."""
        return Report()

    # -- the robots -----------------------------------------------------------------------------------------------

    def on_message(
        self, path: PathId, message: ServiceMessage, ends_at: float, now: float, *, beside: tuple[PathId, ...] = ()
    ) -> None:
        """Take a robot's message, which is of use until `ends_at` (s); some of it came by the paths `beside`."""
        if isinstance(message, RequestMessage):
            self._on_request(ReplyTo(path, message.copy, beside), message.when_left(ends_at - now), now)
        elif isinstance(message, CancelMessage):
            self._on_cancel(path.peer, message.request_id, now)
        else:
            self._parts.stats.dropped["response_to_a_cloud"] += 1

    def _on_request(self, reply_to: ReplyTo, message: RequestMessage, now: float) -> None:
        robot = reply_to.path.peer
        refusal = self._refusal(robot, message, now)
        if refusal and not self.executions.knows(robot, message.request_id):
            self.answers.send([self.executions.refuse_unseen(reply_to, message, *refusal, now)], now)
            return
        rule = self._parts.rules.find(message.service)
        patience_s = rule.lifetime_s if rule else MAX_LIFETIME_S
        outcome = self.executions.on_request(reply_to.path, message, now, patience_s=patience_s, beside=reply_to.beside)
        if isinstance(outcome, ExecuteRequest):
            self._parts.emit(outcome)
        elif isinstance(outcome, Reply):
            self.answers.send([outcome], now)

    def _refusal(self, robot: NodeName, message: RequestMessage, now: float) -> tuple[RejectReason, str] | None:
        if not self._parts.peers.may_call(robot, message.service):
            notice = self._forbidden.note(robot, message.service, now)
            if notice is not None:
                self._parts.emit(notice)
            # First of all: a robot that may not call a service does not learn whether it is offered here either.
            return RejectReason.FORBIDDEN, f"the access policy does not let {robot} call {message.service} here"
        offer = self._offers.get(message.service)
        if offer is None:
            return RejectReason.NOT_OFFERED, f"no server for {message.service}"
        if self._draining:
            return RejectReason.DRAINING, "the sidecar is shutting down"
        if offer.type != message.type:
            return RejectReason.WRONG_TYPE, f"{message.service} has type {offer.type}, not {message.type}"
        return None

    def _on_cancel(self, robot: NodeName, request: RequestId, now: float) -> None:
        """Send no more answers to a robot that has one, and do not start its request if it does not run yet."""
        event = self.executions.cancel(robot, request, now)
        if event is not None:
            self._parts.emit(event)
        self.answers.drop(robot, request)

    def on_room(self, now: float) -> None:
        """Send what waited for room, since less is under way than before."""
        self.answers.on_room(now)

    def on_peers_changed(self, now: float) -> None:
        """Do nothing: a request says which robot it is of."""

    def on_reach_changed(self, now: float) -> None:
        """Do nothing: an answer takes the path by which it can leave."""

    def on_view(self, gone: Collection[NodeName], now: float) -> None:
        """Forget the robots that might have come back: some have, and those in `gone` never will."""
        for name, session in list(self._away.items()):
            current = self._parts.peers.session(name)
            if current == session:
                del self._away[name]
            elif current is not None or name in gone:
                self._end_session(name, now)

    def on_closed(self, peer: NodeName, _session: SessionId, now: float) -> None:
        """Send nothing more to a robot that said goodbye, and call off what servers have not got yet of it."""
        self._end_session(peer, now)

    def on_session_over(self, peer: NodeName, now: float, may_return: SessionId | None) -> None:
        """End a robot's session; with `may_return` it only fell silent, and may come back with it for its answers."""
        if may_return is None:
            self._end_session(peer, now)
            return
        self._away[peer] = may_return
        if len(self._away) > MAX_PEERS:
            self._end_session(next(iter(self._away)), now)

    def on_peer_back(self, peer: NodeName, now: float) -> None:
        """Note that a robot is back; if in a later session, end the one that fell silent."""
        session = self._away.pop(peer, None)
        if session is not None and session != self._parts.peers.session(peer):
            self._end_session(peer, now)

    def _end_session(self, robot: NodeName, now: float) -> None:
        self._away.pop(robot, None)
        called_off = in_groups(partial(self._call_off, robot), self.executions.of_robot(robot))
        let_go = [*self._parts.outbox.drop_peer(robot), *self.answers.drop_robot(robot)]
        self._parts.backlog.add_steps(called_off + let_go, now)

    def _call_off(self, robot: NodeName, request: RequestId) -> None:
        event = self.executions.call_off(robot, request)
        if event is not None:
            self._parts.emit(event)

    def on_peer_gone(self, peer: NodeName, now: float) -> None:
        """Do nothing: nothing is expected of a robot."""

    # -- the paths ------------------------------------------------------------------------------------------------

    def on_path_changed(self, path: PathId, state: PathState, now: float) -> None:
        """Do nothing: robots look for paths."""

    def on_path_gone(self, path: PathId, now: float) -> None:
        """Do nothing: an answer takes another path."""

    def on_path_measured(self, event: PathMeasured) -> None:
        """Do nothing: a cloud reports nothing."""

    def on_copy_lost(self, message: OutboundMessage, now: float) -> None:
        """Do nothing: a robot asks again for an answer that does not come."""

    # -- time -----------------------------------------------------------------------------------------------------

    def next_timer(self) -> float | None:
        """Return when to call `handle_timer`."""
        timers = (self.executions.next_timer(), self.answers.next_timer())
        return min((timer for timer in timers if timer is not None), default=None)

    def on_woken(self, slept_s: float, now: float) -> None:
        """Do nothing: what was asked is remembered for longer."""

    def handle_timer(self, now: float) -> None:
        """Give up what took too long to run or to be sent, as much of it as this turn has room for."""
        abandoned, replies = self.executions.handle_timer(now, self._parts.backlog)
        for event in abandoned:
            self._parts.emit(event)
        self.answers.send(replies, now)
        self.answers.handle_timer(now)
