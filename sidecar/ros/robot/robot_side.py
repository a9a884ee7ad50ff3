"""Passes on a robot's application requests, and answers each from the network or from a fallback."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from plr.sidecar.core.seam.application import (
    CarriedService,
    DeadlineMissed,
    OfferService,
    RequestFailed,
    ResponseArrived,
    Unreachable,
    WithdrawService,
)
from plr.sidecar.ros.cloud.server_processes import ServerProcesses
from plr.sidecar.ros.errors import RosBridgeError
from plr.sidecar.ros.graph import graph
from plr.sidecar.ros.graph.node_names import NodeNames
from plr.sidecar.ros.rcl import NewClientError
from plr.sidecar.ros.robot.fallback_caller import Fallback, FallbackCaller
from plr.sidecar.ros.robot.new_clients import GIVE_UP_S, NewClients
from plr.sidecar.ros.robot.notices import NoticePublisher
from plr.sidecar.ros.robot.proxies import Proxies
from plr.sidecar.ros.robot.reply_pacer import ReplyPacer
from plr.sidecar.ros.robot.request_numbering import RequestNumbering
from plr.sidecar.ros.robot.service_proxy import ServiceProxy

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.sidecar.core.base.values import RequestId
    from plr.sidecar.core.rules.service_rule import ServiceRule
    from plr.sidecar.core.seam.application import ApplicationEvent
    from plr.sidecar.ports import DataPlane
    from plr.sidecar.ros.log_limit import LimitedLog
    from plr.sidecar.ros.rcl import Message, RmwRequestId
    from plr.sidecar.ros.robot.fallback_caller import FallbackAnswer
    from plr.sidecar.ros.ros_loop import RosLoop, Waited
    from plr.sidecar.ros.stats import BridgeStats

MAX_PENDING_REQUESTS = 4096
"""Application requests without an answer; beyond this, new ones are dropped, as an older one may still be in time."""

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Pending:
    proxy: ServiceProxy
    rmw_request_id: RmwRequestId
    client: bytes


@dataclass(frozen=True, slots=True)
class _Answer:
    client: bytes
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
        self._data_plane = data_plane
        self._stats = stats
        self._limited = limited_log
        self._notices = NoticePublisher(loop.node, name)
        self._numbering = RequestNumbering(data_plane.session)
        self._processes = ServerProcesses(loop.domain_id, lambda: graph.participants(loop.node), loop.wake)
        """Server processes of the fallbacks."""
        self._names = NodeNames(loop.node, stats, limited_log)
        self._pacer: ReplyPacer[_Answer] = ReplyPacer()
        self._new_clients: NewClients[_Answer] = NewClients()
        self._fallbacks = FallbackCaller(
            loop=loop,
            rules=rules,
            stats=stats,
            limited_log=limited_log,
            processes=self._processes,
            name_of=self._names.name_of,
            on_failure=self._tell_failure,
        )
        self._pending: dict[RequestId, _Pending] = {}
        self._carried: frozenset[CarriedService] = frozenset()
        """What the data plane was last told."""
        self._proxies = Proxies(
            loop=loop,
            rules=rules,
            stats=stats,
            now=now,
            on_closed=self._proxy_closed,
        )
        self.scan_is_due = False
        """Whether a scan of the graph is due although it has not changed."""

    # -- what the data plane says ------------------------------------------------------------------------------

    def handle(self, event: ApplicationEvent, now: float) -> None:
        """Act on one event of the data plane."""
        match event:
            case ResponseArrived():
                self._answer_from_network(event, now)
            case DeadlineMissed():
                self._miss(event, now)
            case Unreachable():
                self._fallbacks.unreachable(event.request_id, now)
            case RequestFailed():
                self._fail(event, now)
            case OfferService():
                self._proxies.offer(event)
                self._publish_carried()
                self.scan_is_due = True
            case WithdrawService():
                self._proxies.withdraw(event, self._fallbacks.types())
                self._publish_carried()
            case _:
                self._stats.dropped["event_for_other_role"] += 1

    def _miss(self, event: DeadlineMissed, now: float) -> None:
        if not self._fallbacks.deadline_missed(event.request_id, now):
            return  # answered a moment ago
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

    def _answer_from_network(self, event: ResponseArrived, now: float) -> None:
        request_id = event.request_id
        has_answer = request_id not in self._pending and self._fallbacks.has_answered(request_id)
        error = None if has_answer else self._answer(request_id, event.payload, now, late=event.late)
        if error is None:
            self._fallbacks.network_answered(request_id, now)
            self._data_plane.judge_answer(request_id, event.copy, None)
            return
        self._limited.log(
            logging.ERROR,
            (f"bad_response of {event.server}", event.service),
            now,
            "%s: response from %s dropped, other servers are asked: %s",
            event.service,
            event.server,
            error,
        )
        self._data_plane.judge_answer(request_id, event.copy, str(error))

    def _answer_from_fallback(self, answer: FallbackAnswer, now: float) -> None:
        error = self._answer(answer.request_id, answer.payload, now, late=answer.late)
        if error is not None:
            why = f"its fallback: {error}"
            self._tell_failure(RequestFailed(answer.request_id, answer.service, "bad_response", why, 0.0), now)
            return
        self._limited.log(
            logging.WARNING,
            ("fallback", answer.service),
            now,
            "%s: its fallback answered request %s before the network",
            answer.service,
            answer.request_id.hex(),
        )
        self._data_plane.answered_locally(answer.request_id)

    def _answer(
        self, request_id: RequestId, payload: bytes | memoryview, now: float, *, late: bool
    ) -> RosBridgeError | None:
        """Give the application its answer, once; return the error if the bytes are no answer."""
        pending = self._pending.get(request_id)
        if pending is None or not pending.proxy.open:
            # A second answer, or the service was withdrawn while the request was on its way.
            self._stats.dropped["response_without_request"] += 1
            return None
        try:
            response = pending.proxy.parse_answer(payload)
        except RosBridgeError as error:
            return error
        del self._pending[request_id]
        self._stats.pending = len(self._pending)
        answer = _Answer(pending.client, pending.proxy, pending.rmw_request_id, response)
        if self._pacer.admit(pending.client, answer, now, late=late):
            self._send(answer, now)
        else:
            self._stats.answers_paced += 1
        return None

    def _send(self, answer: _Answer, now: float) -> None:
        if self._new_clients.waits(answer.client) or not self._try_to_send(answer, now):
            if not self._new_clients.keep(answer.client, answer, now):
                self._lost(answer, "too many answers wait for new clients", now)

    def _try_to_send(self, answer: _Answer, now: float) -> bool:
        """Return False if the client is not fully discovered yet."""
        if not answer.proxy.open:
            self._stats.dropped["response_without_request"] += 1
            return True
        try:
            answer.proxy.answer(answer.rmw_request_id, answer.response)
        except NewClientError:
            return False
        except RosBridgeError as error:
            self._lost(answer, str(error), now)
            return True
        self._stats.answers_sent[answer.proxy.name] += 1
        return True

    def _lost(self, answer: _Answer, why: str, now: float) -> None:
        service = answer.proxy.name
        self._limited.log(logging.ERROR, ("rmw_error", service), now, "%s: answer lost: %s", service, why)
        self._stats.unanswered[service, "rmw_error"] += 1

    def _try_new_client(self, now: float) -> None:
        due = self._new_clients.take_due(now)
        if due is None:
            return
        client, oldest = due
        if self._try_to_send(oldest, now):
            for answer in self._new_clients.known(client):
                if self._pacer.admit(client, answer, now, late=False):
                    self._send(answer, now)
        else:
            for answer in self._new_clients.unknown(client, time.monotonic()):
                self._lost(answer, f"ROS has not found its client for {GIVE_UP_S:g} s", now)

    def _fail(self, event: RequestFailed, now: float) -> None:
        if self._fallbacks.network_failed(event, now):
            self._tell_failure(event, now)

    def _tell_failure(self, event: RequestFailed, now: float) -> None:
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

    # -- what applications ask, and what fallbacks answer -----------------------------------------------------------

    def take(self, entity: Waited, now: float) -> None:
        """Pass on the requests that have arrived at a proxy, or give applications the answers of a fallback."""
        if isinstance(entity, ServiceProxy):
            for request in entity.take():
                if isinstance(request, RosBridgeError):
                    self._bad_request(entity, request, now)
                else:
                    self._submit(entity, *request, now)
        elif isinstance(entity, Fallback):
            for answer in self._fallbacks.take(entity, now):
                self._answer_from_fallback(answer, now)

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
        self._fallbacks.submitted(request_id, proxy.name, payload, now)

    def _bad_request(self, proxy: ServiceProxy, error: RosBridgeError, now: float) -> None:
        self._stats.requests_taken[proxy.name] += 1
        self._drop_request(proxy, "bad_request", str(error), now)

    def _drop_request(self, proxy: ServiceProxy, reason: str, detail: str, now: float) -> None:
        self._stats.unanswered[proxy.name, reason] += 1
        self._limited.log(logging.ERROR, (reason, proxy.name), now, "%s: a request is dropped: %s", proxy.name, detail)

    def _proxy_closed(self, proxy: ServiceProxy, unseen: int) -> None:
        """Give up the requests at a withdrawn proxy; they get no answer."""
        self._stats.requests_taken[proxy.name] += unseen
        orphans = [request_id for request_id, pending in self._pending.items() if pending.proxy is proxy]
        for request_id in orphans:
            del self._pending[request_id]
        self._stats.pending = len(self._pending)
        if orphans or unseen:
            self._stats.unanswered[proxy.name, "withdrawn"] += len(orphans) + unseen

    # -- what the graph shows ------------------------------------------------------------------------------------

    def settling(self) -> bool:
        """Return whether another scan of the graph should follow soon, even if it does not change."""
        return self._fallbacks.settling or self._proxies.settling

    def scan(self) -> Iterator[None]:
        """Compare the graph with what is offered and with the fallbacks, in small steps."""
        yield from self._proxies.try_configured_types(time.monotonic())
        if not self._proxies.offers and not self._fallbacks.configured:
            return
        wanted = frozenset(self._proxies.offers) | self._fallbacks.wanted
        self._names.begin_scan()
        served = yield from graph.scan(self._loop.node, self._names.name_of, wanted.__contains__, time.monotonic())
        self._stats.scans += 1
        now = time.monotonic()
        self._fallbacks.follow(served, self._proxies.offers, now)
        self._names.end_scan()
        self._processes.forget_the_gone()
        yield
        yield from self._proxies.follow(served, self._fallbacks.types(), now)
        self._publish_carried()

    def _publish_carried(self) -> None:
        up = self._stats.fallback_up
        carried = frozenset(CarriedService(service, up.get(service)) for service in self._stats.carried)
        if carried != self._carried:
            self._carried = carried
            self._data_plane.set_carried(carried)

    # -- time ----------------------------------------------------------------------------------------------------

    def next_due(self) -> float | None:
        """Return when `on_timer` has something to do, or None."""
        dues = (
            self._pacer.next_due(),
            self._new_clients.next_due(),
            self._fallbacks.next_due(),
            self._names.next_due(),
        )
        return min((due for due in dues if due is not None), default=None)

    def on_timer(self, now: float) -> None:
        """Call fallbacks that are due; send the answers that were held back for their clients."""
        if self._processes.take_ended():
            self._fallbacks.strike_out(now)
        self._fallbacks.on_timer(now)
        if self._pacer.queued:
            for answer in self._pacer.take_due(now):
                self._send(answer, now)
        self._try_new_client(now)
        if self._names.turn(now):
            self.scan_is_due = True

    def close(self) -> None:
        """Withdraw every service."""
        self._fallbacks.close()
        self._processes.close()
        self._names.close()
        self._proxies.close()
        self._publish_carried()
