"""Robot side: replicates a request, takes the first valid response, notices the deadline (paper, figure "Workflow
Diagram", request steps 3 to 10).

A copy is one sending of a request to one server. The application judges each answer: if one cannot be delivered, its
copy has failed and its server is out of favour for a while. When the first good answer wins, the other copies are
called off: their unsent parts stay here, and their servers are told. Nobody knows how long a called-off copy
would have taken, and measuring only the copies that were not called off would flatter every path. So one request in
`OBSERVED_ONE_IN` is a full race whose copies are all measured, and the others are not measured at all
(docs/develop/architecture.md, "What is measured").
In a race, once the deadline has passed and another copy has won, a copy that has not arrived is called off. Its time in
the network is known to be longer than that, and is reported so.
"""

from __future__ import annotations

import heapq
from functools import partial
from typing import TYPE_CHECKING

from plr.protos.base.histogram import Histogram
from plr.protos.model.mapping import Assignment
from plr.sidecar.core.base.slices import GROUP, rest
from plr.sidecar.core.base.timers import first_of
from plr.sidecar.core.base.values import PathId, PathState, RejectReason, RequestId
from plr.sidecar.core.robot.dispatch.attention import Attention
from plr.sidecar.core.robot.dispatch.backlog import NoRoom
from plr.sidecar.core.robot.dispatch.cancelling import SMALL_ANSWER_BYTES, CallingOff
from plr.sidecar.core.robot.dispatch.dispatcher import MAX_COPIES_OF_REQUEST, Dispatching
from plr.sidecar.core.robot.measure.outcomes import measure_outcomes
from plr.sidecar.core.robot.request.request import Answer, Copy, CopyState, Request
from plr.sidecar.core.seam.application import DeadlineMissed, RequestFailed, ResponseArrived, Unreachable
from plr.sidecar.core.wire.messages import (
    MAX_NAME_BYTES,
    MAX_PAYLOAD_BYTES,
    RejectionMessage,
    ResponseMessage,
    request_bytes,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator

    from plr.protos.model.ids import NodeName, ServiceName
    from plr.sidecar.core.base.slices import Step
    from plr.sidecar.core.message.outbound import OutboundMessage
    from plr.sidecar.core.robot.dispatch.context import RequestParts
    from plr.sidecar.core.robot.request.service_catalog import Offered

MAX_IN_FLIGHT = 8192
"""Most requests that wait for a response."""
RETRY_S = 0.05
"""A request that was refused for the moment is asked again after twice this, doubled with each copy, ..."""
MAX_RETRY_S = 2.0
"""... and after no more than this for the first MAX_COPIES_OF_REQUEST. Then the time doubles again, so that a server
that takes minutes to start is still asked before the request's lifetime ends, and few bytes travel in vain."""
MAX_REQUEST_TABLE_BYTES = 256 * 1024 * 1024
"""Most payload bytes held. A payload is held until its request's last copy has ended, also while the request waits for
a path or for room."""
TIMER_SLACK = 1024
"""Timers allowed beyond twice those left by the last sweep, before the next one removes those of finished requests."""


class RequestTable:
    """All requests in flight."""

    def __init__(self, parts: RequestParts) -> None:
        self._parts = parts
        self._requests = parts.in_flight
        self._backlog = parts.backlog
        self._timers: list[tuple[float, RequestId]] = []
        self._most_timers = TIMER_SLACK
        self._attention = Attention(parts.command)
        self._calling_off = CallingOff(parts.routes, parts.outbox, parts.stats)
        self._dispatching = Dispatching(parts)
        self._no_room = NoRoom(self._dispatching, parts.routes)
        self._slept_s = 0.0
        """How long the host was suspended in all: a monotonic clock stands still meanwhile."""
        self.unanswered = 0
        self._held_bytes = 0

    # -- the application ------------------------------------------------------------------------------------------

    def submit(self, request_id: RequestId, service: ServiceName, payload: bytes, now: float) -> None:
        """Send a request. It ends in exactly one RequestFailed, or with an answer judged good."""
        offered = self._parts.offers.find(service)
        problem = self._problem(request_id, service, offered, len(payload))
        if offered is None or problem:
            self._count_outcome(service, "rejected")
            self._parts.emit(RequestFailed(request_id, service, "rejected", problem, 0.0))
            return
        kind, rule, servers = offered
        self._attention.ask_for(servers, now)
        size_class = self._parts.measurements.size_class(service, len(payload))
        request = Request(request_id, service, kind, rule, payload, now, size_class)
        request.slept_before_s = self._slept_s
        request.size = request_bytes(service, kind, len(payload))
        self._requests.add(request)
        self._count_unanswered(1)
        self._held_bytes += request.held
        self._arm(request.deadline_at, request_id)
        request.dark = self._parts.routes.dark(servers)
        if self._start(request, self._no_room.open_to(request, servers), now):
            self.on_room(now)  # it may be more urgent than those that wait, or small enough
        self._notice_unreachable(request, now)

    def _problem(self, request_id: RequestId, service: ServiceName, offered: Offered | None, size: int) -> str:
        """Return why a request is rejected; an empty string if it is not."""
        if offered is None:
            return "no server offers this service any more"
        if size > MAX_PAYLOAD_BYTES:
            return f"the request has {size} bytes, the limit is {MAX_PAYLOAD_BYTES}"
        if len(service.encode()) > MAX_NAME_BYTES or len(offered.type.encode()) > MAX_NAME_BYTES:
            return f"the service's name or type is longer than {MAX_NAME_BYTES} bytes"
        if self.unanswered >= MAX_IN_FLIGHT:
            return f"{MAX_IN_FLIGHT} requests are in flight already"
        if self._held_bytes + size > MAX_REQUEST_TABLE_BYTES:
            return f"the requests in flight have {self._held_bytes} bytes already"
        if request_id in self._requests:
            return "a request with this identity is in flight already"
        return ""

    def _count_outcome(self, service: ServiceName, outcome: str) -> None:
        """Count how a request ended: for the metrics, and for the control plane."""
        self._parts.stats.requests[service, outcome] += 1
        self._parts.measurements.outcome(service, outcome)

    def _count_unanswered(self, more: int) -> None:
        self.unanswered += more
        self._parts.stats.in_flight = self.unanswered

    def answered_locally(self, request_id: RequestId, now: float) -> None:
        """Note that the application got its answer on the robot. The request ends at its deadline at the latest."""
        request = self._requests.get(request_id)
        if request is not None and not request.done:
            request.answered_locally = True
            if now >= request.deadline_at:
                self._end_answered_locally(request, now)

    def _start(self, request: Request, servers: list[NodeName], now: float) -> bool:
        """Send a request without copies to some of these servers; return whether it waits for room now."""
        self._look_at(request, self._dispatching.start(request, servers, now))
        return not request.copies and self._no_room.consider(request)

    def on_room(self, now: float) -> None:
        """Send the requests that found no room, each in its turn, since less waits to be sent than before."""
        if len(self._no_room):
            self._backlog.add(partial(self._those_with_room, now), now, "room")

    def _those_with_room(self, now: float) -> Iterator[Step]:
        for request, servers in self._no_room.going(now):
            yield partial(self._go, request, servers)

    def _go(self, request: Request, servers: list[NodeName], now: float) -> None:
        if request.done or request.is_answered:
            return
        if request.copies:
            self._rescue(request, now)
        else:
            self._start(request, servers, now)

    def _rescue(self, request: Request, now: float, *, insist: bool = False, rejected: bool = False) -> None:
        """Rescue a request as in `Dispatching.rescue`, and look at a copy that is alone as at the first one."""
        alone = not request.relied_on()
        self._dispatching.rescue(request, now, insist=insist, rejected=rejected)
        if alone and request.relied_on():
            self._no_room.remove(request)
            self._look_at(request, self._dispatching.first_look(request, now))
        elif request.may_be_sent():
            self._no_room.consider(request, rejected=rejected)
            self._requests.strand(request)

    def _look_at(self, request: Request, when: float | None) -> None:
        if when is not None:
            self._arm(when, request.id)

    def _arm(self, at: float, request_id: RequestId) -> None:
        heapq.heappush(self._timers, (at, request_id))
        if len(self._timers) > self._most_timers:
            self._timers = [timer for timer in self._timers if timer[1] in self._requests]
            heapq.heapify(self._timers)
            self._most_timers = 2 * len(self._timers) + TIMER_SLACK

    # -- the peers ------------------------------------------------------------------------------------------------

    def on_response(self, server: NodeName, response: ResponseMessage, now: float) -> None:
        """Take a server's response to a copy."""
        found = self._find(server, response.request_id, response.copy)
        if found is None:
            return
        request, copy = found
        if copy.state is CopyState.ANSWERED:
            self._parts.stats.duplicate_responses += 1
            return
        measure = request.observed and copy.state is CopyState.PENDING and not copy.hedges
        copy.in_time = copy.state is CopyState.PENDING and now <= request.deadline_at
        copy.state = CopyState.ANSWERED
        copy.certainly_not_run = False  # whatever its server said before
        copy.ended_at = now
        # The response proves that the request arrived, also when the peer's FINISHED got lost.
        self._parts.outbox.on_answered(copy.message)
        answer = Answer(len(response.payload), response.processing_s, now, measure)
        late = now - request.submitted_at > request.rule.deadline_s
        if request.done or (late and request.rule.drop_late):
            self._count_answer(request, copy, answer)
        if request.done:
            self._parts.stats.duplicate_responses += 1
        elif late and request.rule.drop_late:
            if not request.judged:  # otherwise the one that came in time may be good
                self._drop_late(request, copy, answer)
        else:
            self._offer(request, copy, answer, response.payload, late=late)
        self._settle(request, now)

    def _count_answer(self, request: Request, copy: Copy, answer: Answer) -> None:
        """Note what an answer tells about its path and server."""
        self._dispatching.answered(request, copy, answer.processing_s, answer.at)
        if answer.measured:
            took_s = answer.at - copy.sent_at
            self._parts.measurements.answered(request.carried(copy), took_s, answer.processing_s, answer.size)

    def _drop_late(self, request: Request, copy: Copy, answer: Answer) -> None:
        if not request.missed:
            self._miss(request)
        self._end_well(request, answer.at)
        self._parts.stats.late_dropped[request.service] += 1
        elapsed = answer.at - request.submitted_at
        self._parts.emit(RequestFailed(request.id, request.service, "late_dropped", "came after its deadline", elapsed))
        self._call_off_losers(request, copy, answer, answer.at)

    def _offer(self, request: Request, copy: Copy, answer: Answer, payload: bytes | memoryview, *, late: bool) -> None:
        """Let the application judge an answer. Meanwhile the request is as good as answered."""
        if late and not request.missed:
            self._miss(request)
        copy.answer = answer
        request.judged += 1
        elapsed = answer.at - request.submitted_at
        path, number = copy.path, request.copies.index(copy)
        self._parts.emit(
            ResponseArrived(request.id, request.service, number, payload, path.peer, path.interface, elapsed, late)
        )

    def _call_off_losers(self, request: Request, winner: Copy, answer: Answer, now: float) -> None:
        losers = (
            [copy for copy in request.pending() if copy.hedges or not request.observed]
            if len(request.copies) > 1
            else []
        )
        if losers:
            small = answer.size <= SMALL_ANSWER_BYTES
            self._calling_off.call_off(request, losers, now, untold=winner.path.peer if small else None)

    def judge_answer(self, request_id: RequestId, number: int, problem: str | None, now: float) -> None:
        """Take the application's judgement: the answer offered was delivered, or cannot be because of `problem`."""
        request = self._requests.get(request_id)
        copy = None if request is None or number >= len(request.copies) else request.copies[number]
        if request is None or copy is None or copy.answer is None:
            return  # its request ended meanwhile
        answer, copy.answer = copy.answer, None
        request.judged -= 1
        if problem is not None:
            self._answer_is_bad(request, copy, problem, now)
        else:
            self._count_answer(request, copy, answer)
            if request.done:
                self._parts.stats.duplicate_responses += 1
            else:
                self._parts.stats.wins[copy.path.interface, copy.path.peer, request.service] += 1
                self._end_well(request, answer.at)
                self._call_off_losers(request, copy, answer, now)
        self._settle(request, now)

    def _end_well(self, request: Request, at: float) -> None:
        """Finish a request that was answered at this time."""
        elapsed = at - request.submitted_at
        self._finish(request, "deadline_missed" if elapsed > request.rule.deadline_s else "ok")
        durations = self._parts.stats.durations.get(request.service)
        if durations is None:
            durations = self._parts.stats.durations[request.service] = Histogram()
        durations.record(elapsed)

    def _answer_is_bad(self, request: Request, copy: Copy, problem: str, now: float) -> None:
        """Fail the copy as if its server had not answered, and ask others, which replace that server for a while."""
        copy.state = CopyState.REJECTED
        copy.in_time = False
        server = copy.path.peer
        out_s = self._parts.penalties.bad_answer(server, now)
        self._parts.stats.bad_answers[server, request.service] += 1
        self._lost(request, copy, delivered=True)
        if request.done or request.judged:
            return
        if now >= request.deadline_at and not request.missed:
            self._miss(request)
        self._rescue(request, now)
        if not request.pending() and request not in self._no_room:
            if request.may_be_sent() and self._dispatching.candidates(request):
                self._requests.strand(request)
            else:
                why = f"bad answer from {server} (other servers are preferred for {out_s:.0f} s): {problem}"
                self._fail(request, "failed", why, now)

    def on_rejection(self, server: NodeName, rejection: RejectionMessage, now: float) -> None:
        """Take a server's rejection: it did not run a copy, or cannot say what came of it."""
        found = self._find(server, rejection.request_id, rejection.copy)
        if found is None:
            return
        request, copy = found
        if copy.state is not CopyState.PENDING:
            return
        copy.state = CopyState.REJECTED
        copy.message.newest.stand_down()
        copy.certainly_not_run = rejection.reason.certainly_not_run
        self._parts.outbox.on_answered(copy.message)
        self._parts.stats.dropped[f"rejected_{rejection.reason.name.lower()}"] += 1
        if not request.done:
            self._rescue(request, now, rejected=True)
            if not (request.judged or request.pending() or request in self._no_room):
                reason = f"{server}: {rejection.reason.name.lower().replace('_', ' ')}: {rejection.text}"
                if rejection.reason.may_pass and request.may_be_sent():
                    self._wait_out(request, reason, now)
                elif request.may_be_sent() and (
                    rejection.reason is RejectReason.SERVER_LOST or self._dispatching.candidates(request, rejected=True)
                ):
                    # Another server offers the service but is out of reach at present, or one will offer it, as the
                    # only one died. The first path to it that is up takes the request.
                    request.refusal = reason
                    self._requests.strand(request)
                    self._tell_unreachable(request)
                else:
                    self._fail(request, "rejected", reason, now)
        self._settle(request, now)

    def _wait_out(self, request: Request, reason: str, now: float) -> None:
        """Let a request wait for the first of its servers, which seem to restart, and ask them now and then."""
        request.refusal = reason
        self._requests.strand(request)
        copies = len(request.copies)
        retry_s = min(RETRY_S * 2**copies, MAX_RETRY_S) * 2 ** max(0, copies - MAX_COPIES_OF_REQUEST)
        request.retry_at = now + retry_s
        self._look_at(request, request.retry_at)
        self._tell_unreachable(request)

    def _find(self, server: NodeName, request_id: RequestId, number: int) -> tuple[Request, Copy] | None:
        dropped = self._parts.stats.dropped
        request = self._requests.get(request_id)
        if request is None:
            if request_id in self._calling_off:
                self._parts.stats.duplicate_responses += 1
            else:
                dropped["answer_to_unknown_request"] += 1
            return None
        if number >= len(request.copies):
            dropped["answer_to_unknown_copy"] += 1
            return None
        copy = request.copies[number]
        if copy.path.peer != server:
            dropped["answer_from_wrong_server"] += 1
            return None
        return request, copy

    def on_peer_gone(self, peer: NodeName, now: float) -> None:
        """End the copies at a peer whose session ended: they get no answer any more."""
        copies = self._requests.take_copies_at(peer)
        if copies:
            self._backlog.add(lambda: (partial(self._on_copy_dead, *each) for each in copies), now)

    def on_peer_dormant(self, peer: NodeName, now: float) -> None:
        """End the copies at a dormant server of requests that may run twice and send nothing while a copy is awaited.

        All other requests wait for its return, and ask other servers meanwhile as their mode says.
        """
        stuck = [
            (request, copy)
            for request, copy in self._requests.copies_at(peer)
            if copy.state is CopyState.PENDING and request.rule.idempotent and not request.rule.redundancy.helps
        ]
        for _, copy in stuck:
            self._parts.outbox.drop(copy.message)
        if stuck:
            self._backlog.add(lambda: (partial(self._on_copy_dead, *each) for each in stuck), now)

    def _on_copy_dead(self, request: Request, copy: Copy, now: float) -> None:
        copy.session_over = True
        if copy.state is not CopyState.PENDING:
            return
        if copy.message.may_have_left:
            copy.state = CopyState.DEAD
            copy.message.newest.stand_down()
            self._lost(request, copy, delivered=True)
        else:
            self._dispatching.never_left(request, copy, now)
        if not request.done:
            self._rescue(request, now)
            if not (request.judged or request.pending()):
                if request.may_be_sent():
                    self._requests.strand(request)
                else:
                    self._fail(request, "failed", f"{copy.path.peer} went away; it may have run the request", now)
        self._settle(request, now)

    def on_path_changed(self, path: PathId, state: PathState, now: float) -> None:
        """Move requests whose copies are in trouble to another path."""
        if state is PathState.UP:
            self._backlog.add(self._in_trouble, now, "in trouble")
            self.on_room(now)
            return
        if self._requests.uses(path):
            self._backlog.add(partial(self._look_after_path, path), now, path)
        if state is PathState.DOWN and not self._parts.routes.reaches(path.peer):
            self._backlog.add(self._unreachable, now, "unreachable")

    def _look_after_path(self, path: PathId) -> Iterator[Step]:
        return self._each(self._look_after, self._requests.over(path))

    @staticmethod
    def _each(act: Callable[[Request, float], None], requests: Iterable[Request]) -> Iterator[Step]:
        return (partial(act, request) for request in requests)

    def _in_trouble(self) -> Iterator[Step]:
        """Look after the requests that have no copy under way, or have copies only on paths that are not up."""
        yield from self._each(self._look_after, self._requests.stranded())
        for path in self._requests.paths():
            if self._parts.routes.state(path) is not PathState.UP:
                yield from self._each(self._look_after, self._requests.over(path))

    def _unreachable(self) -> Iterator[Step]:
        """Look at all services, some at each step: a server out of reach may have been the last of any of them."""
        for number, service in enumerate(self._requests.services()):
            if number % GROUP == 0:
                yield rest
            if not self._parts.routes.reaches_any(self._parts.offers.servers(service)):
                yield from self._each(self._notice_unreachable, self._requests.of(service))

    def _look_after(self, request: Request, now: float) -> None:
        """Stop relying on the request's copies over paths that are not up, since one of its paths changed."""
        if request.done or request.is_answered or request.id not in self._requests:
            return
        for copy in request.pending():
            if self._parts.routes.best_state(copy.paths) is not PathState.UP:
                copy.message.newest.stand_down()
        self._reconsider(request, now)

    def on_servers_gained(self, services: Collection[ServiceName], now: float) -> None:
        """Send requests that wait for a server to one that newly offers their service."""
        for service in services:
            requests = self._requests.of(service)
            if requests:
                self._backlog.add(partial(self._each, self._ask_now, requests), now, ("gained", service))
        self.on_room(now)

    def _ask_now(self, request: Request, now: float) -> None:
        """Ask at once, whichever server refused for the moment: another one has come, or the same one again."""
        request.retry_at = None
        self._look_after(request, now)

    def withdraw(self, service: ServiceName, reason: str) -> list[Step]:
        """Return the steps that end each request waiting at a service that is not offered here any more."""
        why = f"withdrawn: {reason}"
        return [partial(self._withdraw, request, why) for request in self._requests.of(service)]

    def _withdraw(self, request: Request, why: str, now: float) -> None:
        if not request.done:
            self._end(request, why, now)

    def _reconsider(self, request: Request, now: float) -> None:
        """Send a request that had no path, or whose copies are all in trouble, as there is one more way to a server."""
        if request.copies:
            self._rescue(request, now)
        elif request not in self._no_room:
            self._start(request, self._no_room.open_to(request, self._dispatching.candidates(request)), now)

    def _notice_unreachable(self, request: Request, _now: float) -> None:
        if request.rule.fallback is None or request.found_unreachable or request.done:
            return
        if not self._parts.routes.reaches_any(self._parts.offers.servers(request.service)):
            self._tell_unreachable(request)

    def _tell_unreachable(self, request: Request) -> None:
        if request.rule.fallback is not None and not request.found_unreachable:
            request.found_unreachable = True
            self._parts.emit(Unreachable(request.id, request.service))

    def on_copy_lost(self, message: OutboundMessage, now: float) -> None:
        """Send the backup now if the message of which nothing is heard is a copy that has one."""
        request = None if message.copy_of is None else self._requests.get(message.copy_of)
        if request is None or request.done or not self._dispatching.replaces_lost(request):
            return
        waiting = request.relied_on()
        if len(waiting) == 1 and waiting[0].message.newest is message:
            self._rescue(request, now, insist=True)

    # -- time -----------------------------------------------------------------------------------------------------

    def next_timer(self) -> float | None:
        """Return when to call `handle_timer`."""
        return first_of(self._timers, self._requests)

    def handle_timer(self, now: float) -> None:
        """Handle the deadlines and lifetimes that are over, as many as this turn has room for."""
        while self._timers and self._timers[0][0] <= now and self._backlog.allows(now):
            _, request_id = heapq.heappop(self._timers)
            request = self._requests.get(request_id)
            if request is None:
                continue
            if request.expires_at <= now:
                self._expire(request, now)
                continue
            if request.retry_at is not None and request.retry_at <= now:
                request.retry_at = None
                self._look_after(request, now)
            if now < request.deadline_at:
                self._look_at(request, self._dispatching.look_again(request, now))
                continue
            self._arm(request.expires_at, request_id)
            self._measure(request, now)
            if request.done:
                self._settle(request, now)
            elif request.judged:
                pass  # about to be answered, in time, or rescued
            elif request.answered_locally:
                self._end_answered_locally(request, now)
            elif not request.missed:
                self._miss(request)
                if request.rule.idempotent and request not in self._no_room:  # it does not overtake those that wait
                    self._rescue(request, now, insist=True)

    def on_woken(self, slept_s: float, now: float) -> None:
        """End the requests whose lifetime ended while the host was suspended for `slept_s`.

        Their servers may have forgotten them: a further copy would run a second time.
        """
        self._slept_s += slept_s
        for request in self._requests.all():
            slept_s = self._slept_s - request.slept_before_s
            if request.expires_at - slept_s <= now:
                lifetime_s = request.rule.lifetime_s
                why = f"no answer within {lifetime_s:g} s: this host was suspended for {slept_s:.0f} s"
                self._end(request, why, now)

    def _miss(self, request: Request) -> None:
        request.missed = True
        copies = tuple(Assignment(copy.path.interface, copy.path.peer) for copy in request.copies)
        self._parts.emit(DeadlineMissed(request.id, request.service, request.rule.deadline_s, copies))

    def _end_answered_locally(self, request: Request, now: float) -> None:
        """End a request that the network has not answered by the deadline: it missed and need not answer any more."""
        if not request.observed:
            self._calling_off.call_off(request, request.pending(), now)
        self._fail(request, "deadline_missed", "answered on the robot meanwhile", now)
        self._settle(request, now)

    def _measure(self, request: Request, now: float) -> None:
        """Note, once, which copies missed the deadline, as that is known now."""
        if not request.outcomes_measured:
            self._dispatching.ended(request, now)
            measure_outcomes(request, self._parts.measurements)

    def _lost(self, request: Request, copy: Copy, *, delivered: bool) -> None:
        if request.observed and not copy.hedges:
            self._parts.measurements.lost(request.carried(copy), delivered=delivered)

    def _expire(self, request: Request, now: float) -> None:
        unsent = request.refusal or ("no room to send it" if request in self._no_room else "no path to any server")
        why = unsent if request.certainly_not_run() else "no answer"
        self._end(request, f"{why} within {request.rule.lifetime_s:g} s", now)

    def _end(self, request: Request, reason: str, now: float) -> None:
        for copy in request.pending():
            copy.state = CopyState.DEAD
            self._lost(request, copy, delivered=copy.message.newest.over)
            self._parts.outbox.drop(copy.message)
        if not request.done:
            self._fail(request, "failed", reason, now)
        self._settle(request, now)

    def _fail(self, request: Request, outcome: str, reason: str, now: float) -> None:
        self._finish(request, outcome)
        elapsed = now - request.submitted_at
        self._parts.emit(RequestFailed(request.id, request.service, outcome, reason, elapsed))

    def _finish(self, request: Request, outcome: str) -> None:
        request.done = True
        self._no_room.remove(request)
        request.payload = None
        self._count_unanswered(-1)
        self._count_outcome(request.service, outcome)

    def _settle(self, request: Request, now: float) -> None:
        """Forget a request whose copies have all come to an end."""
        if request.done and request.deadline_at <= now:
            undelivered = [copy for copy in request.pending() if not copy.message.newest.over]
            for copy in undelivered:
                if request.observed and not copy.hedges:
                    self._parts.measurements.called_off(request.carried(copy), now - copy.sent_at)
            self._calling_off.call_off(request, undelivered, now)
        if request.done and not request.pending():
            if self._requests.remove(request):
                self._held_bytes -= request.held
            request.messages.clear()
            self._measure(request, now)
