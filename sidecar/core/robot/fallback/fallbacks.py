"""Robot side: decides when the fallback of a service is asked, and gives the application the first answer.

A request goes to the network at once. It goes to its fallback when that has to begin to be in time, or at once when no
path is up or the network has given up. What the network does with the request is measured as if there were no fallback:
a miss stays a miss.

Like the rest of `core`, this opens nothing: the caller sends what `take_calls` returns, and reports the outcome.
"""

from __future__ import annotations

import heapq
from typing import TYPE_CHECKING, NamedTuple

from plr.protos.model.ids import ServiceName
from plr.sidecar.core.robot.fallback.queue import FallbackQueue, FallbackRequest

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Iterable

    from plr.sidecar.core.base.values import RequestId
    from plr.sidecar.core.rules.service_rule import ServiceRule
    from plr.sidecar.core.seam.application import RequestFailed

MAX_WANTED = 64
"""Most requests that wait for one fallback; a longer queue helps nobody."""
MAX_FALLBACK_BYTES = 256 * 1024 * 1024
"""Most payload bytes kept for fallbacks, as many as for the network: it may give up before the fallbacks do."""
MAX_ATTEMPTS = 4
"""Most times that a fallback is asked one request. A request lost with a fallback is asked again, as the fallback may
take seconds to restart; but not for ever, as the request may have been the cause."""

OUTCOMES = ("started", "won", "late", "too_late", "lost", "missing", "overloaded")
"""Labels of plr_fallback_requests_total."""


class FallbackCall(NamedTuple):
    """A request to ask the fallback of `service`."""

    request_id: RequestId
    service: ServiceName
    payload: bytes


class Accepted(NamedTuple):
    """The delivery of a fallback's answer to the application."""

    service: ServiceName
    late: bool
    """It came after the deadline."""


class Fallbacks:
    """The requests of all services that have a fallback. The caller serialises the calls."""

    def __init__(self, rules: Iterable[ServiceRule], outcomes: Counter[tuple[ServiceName, str]]) -> None:
        """Take the rules; `outcomes` counts (service, one of OUTCOMES)."""
        self._outcomes = outcomes
        self._queues: dict[ServiceName, FallbackQueue] = {
            ServiceName(rule.pattern): FallbackQueue(
                rule.fallback, rule.deadline_s, rule.lifetime_s, drop_late=rule.drop_late
            )
            for rule in rules
            if rule.fallback is not None
        }
        self._requests: dict[RequestId, tuple[ServiceName, FallbackRequest]] = {}
        self._expiries: list[tuple[float, RequestId]] = []
        self._held_bytes = 0
        self._calls: list[FallbackCall] = []
        self._failures: list[RequestFailed] = []
        outcomes.update({(service, outcome): 0 for service in self._queues for outcome in OUTCOMES})

    def __len__(self) -> int:
        """Return the number of requests remembered."""
        return len(self._requests)

    @property
    def services(self) -> dict[ServiceName, ServiceName]:
        """Return each service's fallback."""
        return {name: queue.rule.service for name, queue in self._queues.items()}

    def expected_s(self, service: ServiceName) -> float | None:
        """Return the seconds within which its fallback is expected to answer; None while nothing is known."""
        return self._queues[service].times.expected_s()

    # -- outputs --------------------------------------------------------------------------------------------------

    def take_calls(self) -> list[FallbackCall]:
        """Return the calls to make to fallbacks."""
        calls, self._calls = self._calls, []
        return calls

    def take_failures(self) -> list[RequestFailed]:
        """Return the network's failures of requests that their fallbacks will not answer either."""
        failures, self._failures = self._failures, []
        return failures

    def next_timer(self) -> float | None:
        """Return when to call `handle_timer`."""
        while self._expiries and self._expiries[0][1] not in self._requests:
            heapq.heappop(self._expiries)
        timers = [self._expiries[0][0]] if self._expiries else []
        for queue in self._queues.values():
            timers += [queue.stalled_at(request) for request in queue.called.values()]
            begin_at = queue.begin_at()
            timers += [] if begin_at is None else [begin_at]
        return min(timers, default=None)

    # -- the network ----------------------------------------------------------------------------------------------

    def submitted(self, request_id: RequestId, service: ServiceName, payload: bytes, now: float) -> None:
        """Note that a request goes to the network."""
        queue = self._queues.get(service)
        if queue is None:
            return
        if self._held_bytes + len(payload) > MAX_FALLBACK_BYTES:
            self._outcomes[service, "overloaded"] += 1
            return
        request = FallbackRequest(request_id, payload, now + queue.deadline_s, now + queue.lifetime_s)
        self._requests[request_id] = service, request
        self._held_bytes += len(payload)
        queue.planned[request_id] = request
        heapq.heappush(self._expiries, (request.expires_at, request_id))
        self._begin_due(service, now)

    def unreachable(self, request_id: RequestId, now: float) -> None:
        """Note that no path to any server of a request is up."""
        found = self._requests.get(request_id)
        if found is not None and self._queues[found[0]].rule.in_time:
            self._want(*found, now)

    def deadline_missed(self, request_id: RequestId, now: float) -> bool:
        """Note that the network missed the deadline; return whether the application has no answer yet."""
        found = self._requests.get(request_id)
        if found is None:
            return True
        self._want(*found, now)
        return not found[1].answered

    def has_answered(self, request_id: RequestId) -> bool:
        """Return whether the application has its answer from the fallback."""
        found = self._requests.get(request_id)
        return found is not None and found[1].answered_locally

    def network_answered(self, request_id: RequestId, now: float) -> None:
        """Note that the application has a valid answer from the network."""
        found = self._requests.get(request_id)
        if found is not None:
            name, request = found
            request.answered = request.network_over = True
            self._settle(name, request)
            self._call(name, now)

    def network_failed(self, failure: RequestFailed, now: float) -> bool:
        """Note that the network gives no valid answer; return whether the application gets none at all.

        If False, it has one, or its fallback may answer. If that fails as well, `take_failures` returns the failure.
        """
        found = self._requests.get(failure.request_id)
        if found is None:
            return True
        name, request = found
        request.network_over = True
        self._want(name, request, now)
        if not self._queues[name].up or now >= request.expires_at:
            self._end(name, request)
        else:
            request.failure = failure
            self._settle(name, request)
        return request.over and not request.answered

    # -- the fallbacks --------------------------------------------------------------------------------------------

    def set_up(self, services: frozenset[ServiceName], now: float) -> None:
        """Replace the set of services whose fallback can be asked right now."""
        for name, queue in self._queues.items():
            was_up, queue.up = queue.up, name in services
            if was_up and not queue.up:
                self._lose(name, list(queue.called.values()))
            self._call(name, now)

    def replaced(self, service: ServiceName, now: float) -> None:
        """Note that a fallback was restarted: it will not answer what it was asked before."""
        self._lose(service, list(self._queues[service].called.values()))
        self._call(service, now)

    def answered(self, request_id: RequestId, now: float) -> Accepted | None:
        """Take a fallback's answer; return None if the application does not get it."""
        found = self._requests.get(request_id)
        if found is None:
            return None  # nobody waits any more
        name, request = found
        queue = self._queues[name]
        if queue.called.pop(request_id, None) is not None:
            queue.times.note(request.called_at, now)
        elif request.over or request.answered:
            return None  # given up as lost
        late = now > request.deadline_at
        accepted = None
        if request.answered:
            self._outcomes[name, "too_late"] += 1
        else:
            self._outcomes[name, "late" if late else "won"] += 1
            if not (late and queue.drop_late):
                request.answered = request.answered_locally = True
                accepted = Accepted(name, late)
        self._end(name, request)
        self._call(name, now)
        return accepted

    def refused(self, request_id: RequestId, now: float) -> None:
        """Give up a request that could not be put to its fallback, or whose answer is not valid."""
        found = self._requests.get(request_id)
        if found is not None:
            self._lose(found[0], [found[1]], again=False)
            self._call(found[0], now)

    # -- time -----------------------------------------------------------------------------------------------------

    def handle_timer(self, now: float) -> None:
        """Ask for the requests that have to begin; give up those older than their lifetime."""
        for name, queue in self._queues.items():
            stalled = [request for request in queue.called.values() if queue.stalled_at(request) <= now]
            self._lose(name, stalled)
            self._begin_due(name, now)
            self._call(name, now)
        while self._expiries and self._expiries[0][0] <= now:
            _, request_id = heapq.heappop(self._expiries)
            found = self._requests.get(request_id)
            if found is not None:
                name, request = found
                self._lose(name, [request], again=False)
                self._end(name, request)
                self._call(name, now)

    def _begin_due(self, name: ServiceName, now: float) -> None:
        queue = self._queues[name]
        while (begin_at := queue.begin_at()) is not None and begin_at <= now:
            self._want(name, next(iter(queue.planned.values())), now)

    # -- asking ---------------------------------------------------------------------------------------------------

    def _want(self, name: ServiceName, request: FallbackRequest, now: float) -> None:
        queue = self._queues[name]
        if request.wanted or request.over:
            return
        request.wanted = True
        queue.remove(request)
        if queue.is_worthless(request, now):
            self._end(name, request)
            return
        if not queue.up:
            self._outcomes[name, "missing"] += 1
        if len(queue.wanted) >= MAX_WANTED:
            self._outcomes[name, "overloaded"] += queue.up
            self._end(name, request)
            return
        queue.wanted[request.id] = request
        self._call(name, now)

    def _call(self, name: ServiceName, now: float) -> None:
        """Ask for as many requests as there is room for."""
        queue = self._queues[name]
        while (request := queue.next_call(now)) is not None:
            if queue.is_worthless(request, now):
                del queue.called[request.id]
                self._end(name, request)
                continue
            self._outcomes[name, "started"] += request.attempts == 1
            self._calls.append(FallbackCall(request.id, name, request.payload or b""))

    def _lose(self, name: ServiceName, requests: list[FallbackRequest], *, again: bool = True) -> None:
        """Take back those of these requests that are at the fallback, and ask for them again if allowed."""
        queue = self._queues[name]
        for request in requests:
            if queue.called.pop(request.id, None) is None:
                continue
            if again and request.attempts < MAX_ATTEMPTS:
                queue.wanted[request.id] = request
            else:
                self._outcomes[name, "lost"] += 1
                self._end(name, request)

    def _end(self, name: ServiceName, request: FallbackRequest) -> None:
        """Stop asking the fallback for this request."""
        request.over = True
        if request.failure is not None and not request.answered:
            self._failures.append(request.failure)
            request.failure = None
        self._settle(name, request)

    def _settle(self, name: ServiceName, request: FallbackRequest) -> None:
        """Drop what is not needed any more."""
        queue = self._queues[name]
        if not (request.answered or request.over):
            return
        queue.remove(request)
        self._held_bytes -= len(request.payload or b"")
        request.payload = None
        if request.network_over and request.id not in queue.called:
            self._requests.pop(request.id, None)
