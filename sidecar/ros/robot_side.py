"""Robot: the proxied services, and the applications' requests that wait for an answer."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sidecar.core.events import DeadlineMissed, OfferService, RequestFailed, ResponseArrived, WithdrawService
from sidecar.core.rules import find_rule
from sidecar.ros import graph
from sidecar.ros.errors import RosBridgeError
from sidecar.ros.notices import NoticePublisher
from sidecar.ros.reply_pacer import ReplyPacer
from sidecar.ros.request_numbering import RequestNumbering
from sidecar.ros.service_proxy import ServiceProxy
from sidecar.ros.types import TypeNotInstalledError, load_service_type

if TYPE_CHECKING:
    from protos.model import ServiceName
    from sidecar.core.events import ApplicationEvent, RequestId
    from sidecar.core.rules import ServiceRule
    from sidecar.ports import DataPlane
    from sidecar.ros.log_limit import LimitedLog
    from sidecar.ros.rcl import Message, RmwRequestId
    from sidecar.ros.ros_loop import RosLoop
    from sidecar.ros.stats import BridgeStats

MAX_PENDING_REQUESTS = 4096
"""Applications' requests without an answer; beyond this new ones are dropped, for an older one may still be in time."""
MAX_OFFERED_SERVICES = 512
"""Services that peers may offer; each costs DDS endpoints and a slot in every wait."""
DISCOVERY_SETTLES_S = 1.0
"""After joining the domain, nothing is offered for so long: servers that run here already must be discovered first."""
NAME_IS_FREE_S = 0.15
"""Nobody else must have served a name for so long: two looks. In the cloud's own domain, where robot and cloud may both
be, the server whose service we are offered was perhaps discovered by the cloud's sidecar a moment before ours."""
TYPE_RETRY_S = 30.0
"""How often a type that is not installed is looked for again: someone may be installing it."""

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Pending:
    proxy: ServiceProxy
    rmw_request_id: RmwRequestId
    client: bytes


@dataclass(frozen=True, slots=True)
class _PacedAnswer:
    proxy: ServiceProxy
    rmw_request_id: RmwRequestId
    response: Message


class RobotSide:
    """Offers the peers' services on the robot and answers each request at most once."""

    def __init__(
        self,
        *,
        loop: RosLoop,
        name: str,
        rules: tuple[ServiceRule, ...],
        data_plane: DataPlane,
        stats: BridgeStats,
        limited_log: LimitedLog,
        now: float,
    ) -> None:
        self._loop = loop
        self._own_node = loop.node.get_fully_qualified_name()
        self._rules = rules
        self._data_plane = data_plane
        self._stats = stats
        self._limited = limited_log
        self._notices = NoticePublisher(loop.node, name)
        self._numbering = RequestNumbering(data_plane.session)
        self._pacer: ReplyPacer[_PacedAnswer] = ReplyPacer()
        self._offers: dict[ServiceName, str] = {}
        self._proxies: dict[ServiceName, ServiceProxy] = {}
        self._pending: dict[RequestId, _Pending] = {}
        self._missing_types: dict[ServiceName, str] = {}
        self._left_alone: dict[ServiceName, frozenset[str]] = {}
        self._free_since: dict[ServiceName, float] = {}
        self._types_retried_at = 0.0
        self._settled_at = now + DISCOVERY_SETTLES_S
        self.look_is_due = False
        """The graph should be looked at before the next scan period is over."""

    # -- what the data plane says ------------------------------------------------------------------------------

    def handle(self, event: ApplicationEvent, now: float) -> None:
        """Act on one event of the data plane."""
        match event:
            case ResponseArrived():
                self._answer(event, now)
            case DeadlineMissed():
                self._stats.deadlines_missed[event.service] += 1
                self._limited.log(
                    logging.WARNING,
                    ("deadline", event.service),
                    now,
                    "%s: deadline of %.0f ms missed by request %s on %d paths",
                    event.service,
                    event.deadline_s * 1000,
                    event.request_id.hex(),
                    len(event.copies),
                )
                self._notices.deadline_missed(event)
            case RequestFailed():
                self._fail(event, now)
            case OfferService():
                self._offer(event)
            case WithdrawService():
                self._withdraw(event)
            case _:
                self._stats.dropped["event_for_other_role"] += 1

    def _answer(self, event: ResponseArrived, now: float) -> None:
        pending = self._pending.pop(event.request_id, None)
        self._stats.pending = len(self._pending)
        if pending is None or not pending.proxy.open:
            # A second answer, or the service was withdrawn while the request was on its way.
            self._stats.dropped["response_without_request"] += 1
            return
        try:
            response = pending.proxy.parse_answer(event.payload)
        except RosBridgeError as error:
            self._stats.unanswered[event.service, "bad_response"] += 1
            self._limited.log(
                logging.ERROR,
                ("bad_response", event.service),
                now,
                "%s: response from %s dropped: %s",
                event.service,
                event.server,
                error,
            )
            return
        answer = _PacedAnswer(pending.proxy, pending.rmw_request_id, response)
        if self._pacer.offer(pending.client, answer, now, late=event.late):
            self._send(answer, now)
        else:
            self._stats.answers_paced += 1

    def _send(self, answer: _PacedAnswer, now: float) -> None:
        service = answer.proxy.name
        if not answer.proxy.open:
            self._stats.dropped["response_without_request"] += 1
            return
        try:
            answer.proxy.answer(answer.rmw_request_id, answer.response)
        except RosBridgeError as error:
            self._limited.log(logging.ERROR, ("rmw_error", service), now, "%s: answer lost: %s", service, error)
            self._stats.unanswered[service, "rmw_error"] += 1
            return
        self._stats.answers_sent[service] += 1

    def _fail(self, event: RequestFailed, now: float) -> None:
        if self._pending.pop(event.request_id, None) is None:
            self._stats.dropped["failure_without_request"] += 1
            return
        self._stats.pending = len(self._pending)
        self._stats.unanswered[event.service, event.outcome] += 1
        self._limited.log(
            logging.ERROR,
            (event.outcome, event.service),
            now,
            "%s: request %s gets no answer after %.3f s: %s (%s)",
            event.service,
            event.request_id.hex(),
            event.elapsed_s,
            event.reason,
            event.outcome,
        )
        self._notices.request_failed(event)

    def _offer(self, event: OfferService) -> None:
        if find_rule(self._rules, event.name) is None:
            self._stats.dropped["offer_not_in_rules"] += 1
            log.error("service %s is offered, but no rule of this sidecar carries it", event.name)
            return
        if event.name not in self._offers and len(self._offers) >= MAX_OFFERED_SERVICES:
            self._stats.dropped["too_many_offers"] += 1
            log.error("service %s is not offered here: there are %d already", event.name, MAX_OFFERED_SERVICES)
            return
        if self._offers.get(event.name) != event.type:
            self._close_proxy(event.name)
            self._missing_types.pop(event.name, None)
        self._offers[event.name] = event.type
        self.look_is_due = True

    def _withdraw(self, event: WithdrawService) -> None:
        if self._offers.pop(event.name, None) is None:
            return
        self._missing_types.pop(event.name, None)
        self._left_alone.pop(event.name, None)
        self._free_since.pop(event.name, None)
        if self._close_proxy(event.name):
            log.info("service %s is withdrawn: %s", event.name, event.reason)
        self._publish_state()

    # -- what applications ask -----------------------------------------------------------------------------------

    def _submit(self, proxy: ServiceProxy, rmw_request_id: RmwRequestId, payload: bytes, now: float) -> None:
        self._stats.requests_taken[proxy.name] += 1
        request_id, client = self._numbering.identify(rmw_request_id)
        self._pacer.request_taken(client, now)
        if len(self._pending) >= MAX_PENDING_REQUESTS:
            self._drop_request(proxy, "too_many_pending", f"{MAX_PENDING_REQUESTS} requests are pending", now)
            return
        self._pending[request_id] = _Pending(proxy, rmw_request_id, client)
        self._stats.pending = len(self._pending)
        self._data_plane.submit(request_id, proxy.name, payload)

    def _bad_request(self, proxy: ServiceProxy, error: RosBridgeError, now: float) -> None:
        self._stats.requests_taken[proxy.name] += 1
        self._drop_request(proxy, "bad_request", str(error), now)

    def _drop_request(self, proxy: ServiceProxy, reason: str, detail: str, now: float) -> None:
        self._stats.unanswered[proxy.name, reason] += 1
        self._limited.log(logging.ERROR, (reason, proxy.name), now, "%s: a request is dropped: %s", proxy.name, detail)

    # -- what the graph shows ------------------------------------------------------------------------------------

    @property
    def scan_period_s(self) -> float:
        """Seconds until the graph should be looked at again."""
        return graph.SCAN_PERIOD_S

    def look(self, now: float) -> None:
        """Compare the graph with what is offered; create and withdraw proxies accordingly."""
        self.look_is_due = False
        if not self._offers:
            return
        served = graph.scan(self._loop.node)
        self._stats.scans += 1
        retry_types = now - self._types_retried_at >= TYPE_RETRY_S
        if retry_types:
            self._types_retried_at = now
        for name, type_name in self._offers.items():
            others = self._servers_in_our_way(name, served.get(name))
            if others:
                self._free_since.pop(name, None)
                self._leave_alone(name, others)
                continue
            free_since = self._free_since.setdefault(name, now)
            if now < self._settled_at or now - free_since < NAME_IS_FREE_S:
                continue
            if self._left_alone.pop(name, None):
                log.info("service %s: no other node serves it any more", name)
            if name not in self._proxies and (retry_types or name not in self._missing_types):
                self._open_proxy(name, type_name)
        self._publish_state()

    def _servers_in_our_way(self, name: ServiceName, served: graph.Served | None) -> frozenset[str]:
        if served is None:
            return frozenset()
        others = served.nodes() - {self._own_node}
        if name not in self._proxies:
            return others
        # Two robot sidecars in one domain that proxied the name at the same moment: the smaller name stays.
        return frozenset(node for node in others if not graph.is_sidecar(node) or node < self._own_node)

    def _leave_alone(self, name: ServiceName, others: frozenset[str]) -> None:
        if self._left_alone.get(name) == others:
            return
        self._left_alone[name] = others
        nodes = ", ".join(sorted(others))
        if self._close_proxy(name):
            log.warning("service %s is now served by %s on this robot: ours is withdrawn", name, nodes)
        else:
            log.warning("service %s is already served by %s on this robot: left alone", name, nodes)

    def _open_proxy(self, name: ServiceName, type_name: str) -> None:
        try:
            proxy = ServiceProxy(self._loop.node, name, load_service_type(type_name), self._submit, self._bad_request)
        except RosBridgeError as error:
            if name not in self._missing_types:
                self._missing_types[name] = type_name
                kind = "type_not_installed" if isinstance(error, TypeNotInstalledError) else "service_refused"
                self._stats.errors[kind] += 1
                log.error("service %s is not offered here: %s", name, error)
            return
        self._missing_types.pop(name, None)
        self._proxies[name] = proxy
        self._loop.set_services(tuple(self._proxies.values()))
        log.info("service %s (%s) is offered here", name, type_name)

    def _close_proxy(self, name: ServiceName) -> bool:
        proxy = self._proxies.pop(name, None)
        if proxy is None:
            return False
        self._loop.set_services(tuple(self._proxies.values()))
        unseen = proxy.close()
        self._stats.requests_taken[name] += unseen
        orphans = [request_id for request_id, pending in self._pending.items() if pending.proxy is proxy]
        for request_id in orphans:
            del self._pending[request_id]
        self._stats.pending = len(self._pending)
        if orphans or unseen:
            self._stats.unanswered[name, "withdrawn"] += len(orphans) + unseen
        return True

    def _publish_state(self) -> None:
        self._stats.left_alone = {name: tuple(sorted(nodes)) for name, nodes in self._left_alone.items()}
        self._stats.missing_types = dict(self._missing_types)
        carried = frozenset(self._proxies)
        if carried != self._stats.carried:
            self._stats.carried = carried
            self._data_plane.set_carried(carried)

    # -- time ----------------------------------------------------------------------------------------------------

    def next_due(self) -> float | None:
        """Return when `on_timer` has something to do, or None."""
        return self._pacer.next_due()

    def on_timer(self, now: float) -> None:
        """Send the answers that were held back for their clients' sake."""
        if self._pacer.queued:
            for answer in self._pacer.take_due(now):
                self._send(answer, now)

    def close(self) -> None:
        """Withdraw every proxy."""
        for name in tuple(self._proxies):
            self._close_proxy(name)
        self._offers.clear()
        self._publish_state()
