"""Cloud side: runs every request at most once here, however many copies arrive.

A request is running (copies wait for its result), answered (copies get the cached answer) or forgotten: its id is
kept as a tombstone after the answer was dropped, so that a very late copy is refused and not run again. An id is
dropped only when no copy can come any more: its sender gives a request up when its lifetime is over. If a request was
refused without being run, its copies are remembered, not its id (`refused_copies.py`): another copy may run.

An id counts only for the robot that sent it: a member that learns another's ids, and sends them first, takes nothing
from it.

A robot that has its answer calls a request off. Then the request does not run if the local server has not got it yet,
nobody is answered any more, and copies that still come are ignored.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from plr.sidecar.core.base.fair_share import FORGOTTEN_AT_ONCE, Shares
from plr.sidecar.core.base.timers import first_of
from plr.sidecar.core.base.values import ExecutionId, RejectReason, RequestId
from plr.sidecar.core.cloud.answer_budget import AnswerBudget
from plr.sidecar.core.cloud.early_cancels import EarlyCancels
from plr.sidecar.core.cloud.refused_copies import RefusedCopies, RefusedCopy
from plr.sidecar.core.rules.service_rule import MAX_LIFETIME_S
from plr.sidecar.core.seam.application import AbandonExecution, CancelExecution, ExecuteRequest
from plr.sidecar.core.wire.messages import MAX_PAYLOAD_BYTES, RejectionMessage, ResponseMessage

if TYPE_CHECKING:
    from collections.abc import Collection

    from plr.protos.model.ids import NodeName, ServiceName
    from plr.sidecar.core.base.slices import Backlog
    from plr.sidecar.core.base.values import PathId, Priority
    from plr.sidecar.core.seam.stats import EngineStats
    from plr.sidecar.core.wire.messages import RequestMessage

MAX_RUNNING = 8192
"""Most requests that local servers work on at once."""
MAX_RUNNING_BYTES = 512 * 1024 * 1024
"""Most payload bytes of those requests: local servers may be slower than the robots. One robot may hold half."""
MAX_WAITERS = 16
"""Most copies that wait for one result; a robot sends one for each of its interfaces."""
MAX_CACHED_BYTES = 64 * 1024 * 1024
"""Bytes of answers kept for late copies; beyond that the robot that holds the most loses its oldest."""
MAX_REMEMBERED_IDS = 262_144
"""Ids remembered; one robot may fill half: 2000 requests a second for MIN_REMEMBER_S."""
REMEMBER_LIFETIMES = 2.0
"""An id is remembered after the answer for this many lifetimes of its request ..."""
MIN_REMEMBER_S = 60.0
"""... but at least this long: the time that a datagram may spend in the queues of the network."""
SAY_WITHIN_S = 0.5
"""An execution whose patience is over counts as lost unless the application says within this time what became of it."""

TIMER_SLACK = 1024
"""Timers of answered requests allowed to remain before they are swept out."""


class _Key(NamedTuple):
    """A request, by the robot that asked and the id it chose."""

    robot: NodeName
    request_id: RequestId


@dataclass(frozen=True, slots=True)
class ReplyTo:
    """The destination of one copy's answer."""

    path: PathId
    copy: int
    beside: tuple[PathId, ...] = field(default=(), compare=False)
    """Further paths by which some of it came: they may carry the answer as well."""


@dataclass(frozen=True, slots=True)
class Reply:
    """A message to the robot, wanted by `deadline` and useless after `expires`."""

    to: ReplyTo
    service: ServiceName
    message: ResponseMessage | RejectionMessage
    priority: Priority
    deadline: float
    expires: float


@dataclass(slots=True)
class _Execution:
    id: ExecutionId
    key: _Key
    service: ServiceName
    priority: Priority
    deadline: float
    """When the robot wants its answer."""
    expires: float
    """When the robot stops waiting."""
    patience_ends: float
    """When the local server is given up, even if the robot waits."""
    lifetime_s: float
    """The longest lifetime that a copy asked for."""
    size: int
    """Bytes of the request's payload."""
    waiters: list[ReplyTo] = field(default_factory=list)
    payload: bytes | None = None
    processing_s: float = 0.0
    refusal: tuple[RejectReason, str] | None = None
    cancelled: bool = False
    given_up: bool = False
    """Its patience is over: the application is asked whether the local server got it."""

    @property
    def robot(self) -> NodeName:
        """Return the robot that asked."""
        return self.key.robot

    @property
    def request_id(self) -> RequestId:
        """Return the robot's id of the request."""
        return self.key.request_id

    @property
    def ends(self) -> float:
        """Return when this execution is given up."""
        return min(self.expires, self.patience_ends)


class ExecutionTable:
    """All requests this sidecar has seen recently."""

    def __init__(self, stats: EngineStats) -> None:
        self._stats = stats
        self._by_request: dict[_Key, _Execution] = {}
        """Executions that run."""
        self._finished: dict[_Key, _Execution] = {}
        self._forget_at: list[tuple[float, _Key]] = []
        """Heap of when each finished execution is forgotten."""
        self._running: dict[ExecutionId, _Execution] = {}
        self._running_shares = Shares(MAX_RUNNING)
        self._running_bytes = Shares(MAX_RUNNING_BYTES)
        self._finished_shares = Shares(MAX_REMEMBERED_IDS)
        self._cache = AnswerBudget(MAX_CACHED_BYTES)
        self._timers: list[tuple[float, ExecutionId]] = []
        self._next_id = 0
        self._early_cancels = EarlyCancels(stats)
        self._refused = RefusedCopies(stats)

    @property
    def running(self) -> int:
        """Return the number of requests being worked on."""
        return len(self._running)

    def awaited(self, robots: Collection[NodeName]) -> int:
        """Return the number of requests being worked on that one of these robots still waits for."""
        return sum(1 for execution in self._running.values() if not execution.cancelled and execution.robot in robots)

    def knows(self, robot: NodeName, request_id: RequestId) -> bool:
        """Return whether a copy of this robot's request came before."""
        return self._find(robot, request_id) is not None

    def _find(self, robot: NodeName, request_id: RequestId) -> _Execution | None:
        key = _Key(robot, request_id)
        return self._by_request.get(key) or self._finished.get(key)

    def on_request(
        self,
        path: PathId,
        message: RequestMessage,
        now: float,
        *,
        patience_s: float = MAX_LIFETIME_S,
        beside: tuple[PathId, ...] = (),
    ) -> ExecuteRequest | Reply | None:
        """Take one copy: run the request, answer from the cache, refuse, or (None) let it wait for the result.

        A request whose first copy comes after its lifetime is neither run nor answered: its robot has given it up.

        The local server may take as long as the robot waits, but at most `patience_s`.
        """
        reply_to = ReplyTo(path, message.copy, beside)
        key = _Key(path.peer, message.request_id)
        running = self._by_request.get(key)
        execution = running or self._finished.get(key)
        lifetime = min(message.lifetime_left_s, MAX_LIFETIME_S)
        count = self._stats.executions
        if execution is not None:
            if execution.service != message.service:
                self._stats.dropped["request_id_mismatch"] += 1
                return None
            if execution.cancelled:
                count[message.service, "cancelled"] += 1
                return None
            if running is not None:
                if len(execution.waiters) < MAX_WAITERS and reply_to not in execution.waiters:
                    execution.waiters.append(reply_to)
                    execution.expires = max(execution.expires, now + lifetime)
                    execution.lifetime_s = max(execution.lifetime_s, lifetime)
                count[message.service, "coalesced"] += 1
                return None
            count[message.service, "cached"] += 1
            return self._reply(execution, reply_to, now + lifetime)
        if lifetime <= 0:
            self._stats.dropped["request_expired"] += 1
            return None
        self._forget_old(now)
        if self._early_cancels.holds(path.peer, message.request_id, now):
            count[message.service, "cancelled"] += 1
            return None
        refused = self._refused.why(RefusedCopy(path.peer, message.request_id, message.copy), now)
        if refused is not None:
            return self.refuse_unseen(reply_to, message, *refused, now)
        size = len(message.payload)
        if not (
            self._running_shares.fits(path.peer)
            and self._running_bytes.fits(path.peer, size)
            and self._finished_shares.fits(path.peer)
        ):
            self._stats.dropped["executions_full"] += 1
            return self.refuse_unseen(reply_to, message, RejectReason.OVERLOADED, "too many requests", now)
        execution = _Execution(
            ExecutionId(self._next_id),
            key,
            message.service,
            message.priority,
            now + message.deadline_left_s,
            now + lifetime,
            now + patience_s,
            lifetime,
            size,
            [reply_to],
        )
        self._next_id += 1
        self._running_shares.take(path.peer)
        self._running_bytes.take(path.peer, size)
        self._by_request[key] = execution
        self._running[execution.id] = execution
        self._stats.in_flight = len(self._running)
        self._arm(execution)
        count[message.service, "run"] += 1
        return ExecuteRequest(
            execution.id,
            message.service,
            message.type,
            message.payload,
            path.peer,
            message.priority,
            message.deadline_left_s,
            min(lifetime, patience_s),
        )

    def _arm(self, execution: _Execution) -> None:
        heapq.heappush(self._timers, (execution.ends, execution.id))
        if len(self._timers) > 2 * len(self._running) + TIMER_SLACK:
            self._timers = [timer for timer in self._timers if timer[1] in self._running]
            heapq.heapify(self._timers)

    def refuse_unseen(
        self, reply_to: ReplyTo, message: RequestMessage, reason: RejectReason, text: str, now: float
    ) -> Reply:
        """Refuse a copy: the request has not run here, and another copy of it may run later."""
        # These are not counted by name: a peer may write any name, and would create as many counters as it likes.
        if reason is RejectReason.NOT_OFFERED:
            self._stats.dropped["request_for_unknown_service"] += 1
        elif reason is RejectReason.FORBIDDEN:
            self._stats.dropped["request_forbidden"] += 1
        else:
            self._stats.executions[message.service, "refused"] += 1
        rejection = RejectionMessage(message.request_id, message.copy, reason, text)
        expires = now + min(message.lifetime_left_s, MAX_LIFETIME_S)
        self._remember_refused(reply_to, message.request_id, reason, text, expires, now)
        return Reply(reply_to, message.service, rejection, message.priority, now + message.deadline_left_s, expires)

    def complete(self, execution_id: ExecutionId, payload: bytes, processing_s: float, now: float) -> list[Reply]:
        """Take the local server's answer; return the replies to send."""
        if len(payload) > MAX_PAYLOAD_BYTES:
            text = f"the answer has {len(payload)} bytes, the limit is {MAX_PAYLOAD_BYTES}"
            return self.refuse(execution_id, RejectReason.TOO_LARGE, text, now)
        execution = self._finish(execution_id)
        if execution is None:
            return []
        self._remember(execution, now)
        if execution.cancelled:
            return []
        execution.payload = payload
        execution.processing_s = processing_s
        self._keep(execution)
        return [self._reply(execution, reply_to, execution.expires) for reply_to in execution.waiters]

    def refuse(self, execution_id: ExecutionId, reason: RejectReason, text: str, now: float) -> list[Reply]:
        """Note that the local server did not answer; return the replies to send."""
        execution = self._finish(execution_id)
        if execution is None:
            return []
        if execution.cancelled or not reason.certainly_not_run:
            self._remember(execution, now)
        else:
            for reply_to in execution.waiters:
                self._remember_refused(reply_to, execution.request_id, reason, text, execution.expires, now)
        if not execution.given_up:
            result = "cancelled" if reason is RejectReason.CANCELLED else "refused"
            self._stats.executions[execution.service, result] += 1
        execution.refusal = (reason, text)
        return [self._reply(execution, reply_to, execution.expires) for reply_to in execution.waiters]

    def _remember_refused(
        self, reply_to: ReplyTo, request_id: RequestId, reason: RejectReason, text: str, expires: float, now: float
    ) -> None:
        copy = RefusedCopy(reply_to.path.peer, request_id, reply_to.copy)
        self._refused.add(copy, reason, text, max(expires, now + MIN_REMEMBER_S), now)

    def cancel(self, robot: NodeName, request_id: RequestId, now: float) -> CancelExecution | None:
        """Take a robot's cancel, which may precede its request; return what to tell the application, if anything."""
        if not self.knows(robot, request_id):
            self._early_cancels.add(robot, request_id, now)
            return None
        return self.call_off(robot, request_id)

    def call_off(self, robot: NodeName, request_id: RequestId) -> CancelExecution | None:
        """Stop answering this request; return what to tell the application, if anything."""
        execution = self._find(robot, request_id)
        if execution is None or execution.cancelled:
            return None
        self._cancel(execution)
        return CancelExecution(execution.id, robot) if execution.id in self._running else None

    def of_robot(self, robot: NodeName) -> list[RequestId]:
        """Return the robot's requests that are being worked on and not called off."""
        return [one.request_id for one in self._running.values() if one.robot == robot and not one.cancelled]

    def _cancel(self, execution: _Execution) -> None:
        execution.cancelled = True
        execution.waiters.clear()
        execution.payload = None
        self._cache.remove(*execution.key)

    def next_timer(self) -> float | None:
        """Return when to call `handle_timer`."""
        return first_of(self._timers, self._running)

    def handle_timer(self, now: float, backlog: Backlog) -> tuple[list[AbandonExecution], list[Reply]]:
        """Give up executions that took too long.

        Return them, and the replies for executions that robots still wait for and of which the application has not said
        within SAY_WITHIN_S whether the local server got them: they may have run, so their ids stay. Also forget what no
        copy can ask for any more, so that answers do not stay in memory when the traffic ends.
        """
        self._forget_old(now)
        abandoned = []
        replies = []
        while self._timers and self._timers[0][0] <= now and backlog.allows(now):
            _, execution_id = heapq.heappop(self._timers)
            execution = self._running.get(execution_id)
            if execution is None:
                continue
            if execution.ends > now:
                heapq.heappush(self._timers, (execution.ends, execution_id))
                continue
            awaited = bool(execution.waiters) and execution.expires > now
            if not execution.given_up:
                self._stats.executions[execution.service, "abandoned"] += 1
                abandoned.append(AbandonExecution(execution_id, execution.robot, awaited))
                if awaited:
                    execution.given_up = True
                    execution.patience_ends = now + SAY_WITHIN_S
                    heapq.heappush(self._timers, (execution.ends, execution_id))
                    continue
            self._finish(execution_id)
            self._remember(execution, now)
            execution.refusal = (RejectReason.SERVER_LOST, "the server did not answer in time")
            if awaited:
                replies += [self._reply(execution, reply_to, execution.expires) for reply_to in execution.waiters]
        return abandoned, replies

    def _finish(self, execution_id: ExecutionId) -> _Execution | None:
        """Remove and return a running execution; None if it does not run (any more)."""
        execution = self._running.pop(execution_id, None)
        if execution is None:
            self._stats.dropped["answer_to_unknown_execution"] += 1
            return None
        self._stats.in_flight = len(self._running)
        del self._by_request[execution.key]
        robot = execution.key.robot
        self._running_shares.give_back(robot)
        self._running_bytes.give_back(robot, execution.size)
        return execution

    def _remember(self, execution: _Execution, now: float) -> None:
        """Remember an execution that ran or may have run, so that it never runs again."""
        self._finished[execution.key] = execution
        self._finished_shares.take(execution.key.robot)
        forget_at = now + max(REMEMBER_LIFETIMES * execution.lifetime_s, MIN_REMEMBER_S)
        heapq.heappush(self._forget_at, (forget_at, execution.key))

    def _reply(self, execution: _Execution, reply_to: ReplyTo, expires: float) -> Reply:
        request_id = execution.request_id
        if execution.payload is not None:
            response = ResponseMessage(request_id, reply_to.copy, execution.processing_s, execution.payload)
            return Reply(reply_to, execution.service, response, execution.priority, execution.deadline, expires)
        reason, text = execution.refusal or (
            RejectReason.FORGOTTEN,
            "the request was answered before, and its answer is no longer kept",
        )
        rejection = RejectionMessage(request_id, reply_to.copy, reason, text)
        return Reply(reply_to, execution.service, rejection, execution.priority, execution.deadline, expires)

    def _keep(self, execution: _Execution) -> None:
        for robot, request_id in self._cache.add(*execution.key, len(execution.payload or b"")):
            self._finished[_Key(robot, request_id)].payload = None
            self._stats.dropped["cached_answer_evicted"] += 1

    def _forget_old(self, now: float) -> None:
        """Drop ids that no copy can ask for any more: at most one burst of them, the rest in later calls."""
        for _ in range(FORGOTTEN_AT_ONCE):
            if not self._forget_at or self._forget_at[0][0] > now:
                return
            key = heapq.heappop(self._forget_at)[1]
            del self._finished[key]
            self._finished_shares.give_back(key.robot)
            self._cache.remove(*key)
