"""Finds and calls the local services of a robot that stand in for the network.

`plr.sidecar.core.robot.fallback.fallbacks` decides when they are called, and which answer counts.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from plr.sidecar.core.robot.fallback.fallbacks import Fallbacks
from plr.sidecar.ros.cloud.local_server import LocalServer
from plr.sidecar.ros.errors import RosBridgeError
from plr.sidecar.ros.types import load_service_type

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from plr.protos.model.ids import ServiceName
    from plr.sidecar.core.base.values import RequestId
    from plr.sidecar.core.robot.fallback.fallbacks import FallbackCall
    from plr.sidecar.core.rules.service_rule import ServiceRule
    from plr.sidecar.core.seam.application import RequestFailed
    from plr.sidecar.ros.cloud.server_processes import ServerProcesses
    from plr.sidecar.ros.graph.graph import NameOf, Served
    from plr.sidecar.ros.log_limit import LimitedLog
    from plr.sidecar.ros.ros_loop import RosLoop
    from plr.sidecar.ros.stats import BridgeStats

MAX_ASKED_OF_FALLBACK = 64
"""Requests whose number at one fallback is remembered; beyond this the oldest, lost long ago, is forgotten."""
COMPLAIN_AFTER_S = 5.0
"""How long a fallback may be missing before that is logged: the robot's nodes start together."""
KEPT_FOR_S = 15.0
"""How long a service is still offered without its fallback and any server: a node that crashed is restarted within
seconds, and the requests made meanwhile wait for it."""
TYPE_RETRY_S = 30.0
"""How often a type that is not installed is tried again."""

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class FallbackAnswer:
    """An answer that the application gets."""

    request_id: RequestId
    service: ServiceName
    payload: bytes
    late: bool


class Fallback:
    """A fallback found in the local graph."""

    def __init__(self, server: LocalServer) -> None:
        self.server = server
        self._asked: dict[int, RequestId] = {}
        """Requests by rmw's sequence number."""

    @property
    def handle(self) -> Any:
        """rclpy's handle."""
        return self.server.handle

    def ask(self, call: FallbackCall) -> None:
        """Send a request. Raises RosBridgeError."""
        number = self.server.send(self.server.type.request.deserialize(call.payload))
        self._asked[number] = call.request_id
        if len(self._asked) > MAX_ASKED_OF_FALLBACK:
            del self._asked[next(iter(self._asked))]

    def take(self) -> Iterator[tuple[RequestId | None, bytes]]:
        """Yield the answers that have arrived, each with its request; None stands for one that is not awaited."""
        for number, payload in self.server.take():
            yield self._asked.pop(number, None), payload


@dataclass(slots=True)
class _Complaint:
    """Why a fallback cannot be called."""

    text: str
    since: float
    told: bool = False


class FallbackCaller:
    """Finds the fallbacks in the local graph and calls them. All methods belong to the ROS thread."""

    def __init__(
        self,
        *,
        loop: RosLoop,
        rules: Iterable[ServiceRule],
        stats: BridgeStats,
        limited_log: LimitedLog,
        processes: ServerProcesses,
        name_of: NameOf,
        on_failure: Callable[[RequestFailed, float], None],
    ) -> None:
        """Call `on_failure` to end a request that gets no answer."""
        self._loop = loop
        self._processes = processes
        self._name_of = name_of
        self._stats = stats
        self._limited = limited_log
        self._on_failure = on_failure
        self._policy = Fallbacks(rules, stats.fallbacks)
        self._fallbacks: dict[ServiceName, Fallback] = {}
        self._up: frozenset[ServiceName] = frozenset()
        self._types: dict[ServiceName, tuple[str, float]] = {}
        """Types of the fallbacks that can be called, or could lately, and when that was last seen."""
        self._complaints: dict[ServiceName, _Complaint] = {}
        self._refused: dict[ServiceName, str] = {}
        """Services whose fallback's type cannot be used here, with that type."""
        self._types_retried_at = 0.0
        self._publish_state()

    @property
    def configured(self) -> bool:
        """Whether any service has a fallback."""
        return bool(self._policy.services)

    @property
    def wanted(self) -> frozenset[ServiceName]:
        """The services that have a fallback, and those that serve as one."""
        return frozenset(self._policy.services) | frozenset(self._policy.services.values())

    @property
    def settling(self) -> bool:
        """Whether a fallback that was found cannot be called yet."""
        return len(self._up) < len(self._fallbacks)

    def strike_out(self, now: float) -> None:
        """Strike out the servers of processes that ended; a fallback's may be among them."""
        for service, fallback in self._fallbacks.items():
            if fallback.server.strike_out(self._processes.has_ended):
                self._replaced(service, now)
        self._note_up(now)

    def types(self) -> dict[ServiceName, str]:
        """Return the services whose fallback can be called, or is likely to come back, with their types."""
        return {service: kind for service, (kind, _) in self._types.items()}

    # -- outcomes of requests --------------------------------------------------------------------------------------

    def submitted(self, request_id: RequestId, service: ServiceName, payload: bytes, now: float) -> None:
        """Note that a request goes to the network."""
        self._policy.submitted(request_id, service, payload, now)
        self._act(now)

    def unreachable(self, request_id: RequestId, now: float) -> None:
        """Note that no path to any server is up."""
        self._policy.unreachable(request_id, now)
        self._act(now)

    def deadline_missed(self, request_id: RequestId, now: float) -> bool:
        """Note that the network missed the deadline; return whether the application has no answer yet."""
        unanswered = self._policy.deadline_missed(request_id, now)
        self._act(now)
        return unanswered

    def has_answered(self, request_id: RequestId) -> bool:
        """Return whether the application has its answer from a fallback."""
        return self._policy.has_answered(request_id)

    def network_answered(self, request_id: RequestId, now: float) -> None:
        """Note that the network's answer has arrived."""
        self._policy.network_answered(request_id, now)
        self._act(now)

    def network_failed(self, failure: RequestFailed, now: float) -> bool:
        """Note that the network gives no answer; return whether no fallback can give one either."""
        hopeless = self._policy.network_failed(failure, now)
        self._act(now)
        return hopeless

    def take(self, fallback: Fallback, now: float) -> Iterator[FallbackAnswer]:
        """Yield the answers of `fallback` that the application gets."""
        for request_id, payload in fallback.take():
            if request_id is None:
                # Its request was given up as lost, or two nodes serve one name and this is the second answer.
                self._stats.dropped["answer_without_execution"] += 1
                continue
            accepted = self._policy.answered(request_id, now)
            if accepted is not None:
                yield FallbackAnswer(request_id, accepted.service, payload, accepted.late)
            self._act(now)

    def _act(self, now: float) -> None:
        while calls := self._policy.take_calls():
            for call in calls:
                try:
                    self._fallbacks[call.service].ask(call)
                except RosBridgeError as error:
                    self._limited.log(
                        logging.ERROR,
                        ("fallback", call.service),
                        now,
                        "service %s: its fallback is not asked: %s",
                        call.service,
                        error,
                    )
                    self._policy.refused(call.request_id, now)
        for failure in self._policy.take_failures():
            self._on_failure(failure, now)

    # -- what the graph shows --------------------------------------------------------------------------------------

    def follow(self, served: Mapping[ServiceName, Served], offers: Mapping[ServiceName, str], now: float) -> None:
        """Track the fallbacks in the graph; they must have the types in `offers`, the services of the network."""
        retry_types = now - self._types_retried_at >= TYPE_RETRY_S
        if retry_types:
            self._types_retried_at = now
        for service, name in self._policy.services.items():
            types = frozenset(served[name].applications()) if name in served else frozenset()
            self._follow(service, name, types, offers.get(service), now, retry_types=retry_types)
        self._note_up(now)
        self._types = {name: known for name, known in self._types.items() if now - known[1] < KEPT_FOR_S}
        self._types.update({name: (self._fallbacks[name].server.type.name, now) for name in self._up})
        self._publish_state()

    def _note_up(self, now: float) -> None:
        up = frozenset(name for name, fallback in self._fallbacks.items() if fallback.server.ready)
        for service in up - self._up:
            log.info("service %s: its fallback %s is available", service, self._policy.services[service])
        if up != self._up:
            self._up = up
            self._policy.set_up(up, now)
            self._act(now)

    def _replaced(self, service: ServiceName, now: float) -> None:
        log.warning("service %s: its fallback %s is gone or was restarted", service, self._policy.services[service])
        self._policy.replaced(service, now)
        self._act(now)

    def _follow(
        self,
        service: ServiceName,
        name: ServiceName,
        types: frozenset[str],
        wanted: str | None,
        now: float,
        *,
        retry_types: bool,
    ) -> None:
        fallback = self._fallbacks.get(service)
        used = None if fallback is None else fallback.server.type.name
        if wanted is None:
            wanted = used if used in types else min(types, default=None)
        if fallback is not None and (used != wanted or used not in types):
            self._close(service, now)
            fallback = None
        if fallback is not None:
            if fallback.server.scan(self._processes.has_ended, now):
                self._replaced(service, now)
            for endpoint in fallback.server.endpoints:
                self._processes.watch(endpoint)
        elif not types:
            self._complain(service, f"no node serves {name} on this robot: start the one that does", now)
        elif wanted not in types:
            found = ", ".join(sorted(types))
            self._complain(service, f"{name} has type {found}, not {wanted} like the servers of {service}", now)
        elif retry_types or self._refused.get(service) != wanted:
            self._open(service, name, wanted, now)

    def _open(self, service: ServiceName, name: ServiceName, type_name: str, now: float) -> None:
        try:
            server = LocalServer(self._loop.node, name, load_service_type(type_name), self._name_of)
        except RosBridgeError as error:
            self._refused[service] = type_name
            self._complain(service, str(error), now)
            return
        self._refused.pop(service, None)
        self._complaints.pop(service, None)
        self._fallbacks[service] = Fallback(server)
        self._loop.set_clients(tuple(self._fallbacks.values()))

    def _close(self, service: ServiceName, now: float) -> None:
        fallback = self._fallbacks.pop(service)
        self._loop.set_clients(tuple(self._fallbacks.values()))
        fallback.server.close()
        if service in self._up:
            self._up -= {service}
            self._policy.set_up(self._up, now)
            self._act(now)
            log.warning("service %s: its fallback %s is gone", service, self._policy.services[service])

    def _complain(self, service: ServiceName, text: str, now: float) -> None:
        complaint = self._complaints.get(service)
        if complaint is None or complaint.text != text:
            complaint = self._complaints[service] = _Complaint(text, now)
        if not complaint.told and now - complaint.since >= COMPLAIN_AFTER_S:
            complaint.told = True
            log.error("service %s has no fallback: %s", service, text)

    def _publish_state(self) -> None:
        policy = self._policy
        self._stats.fallback_up = {service: service in self._up for service in policy.services}
        times = {service: policy.expected_s(service) for service in policy.services}
        self._stats.fallback_takes_s = {name: takes_s for name, takes_s in times.items() if takes_s is not None}

    # -- time ------------------------------------------------------------------------------------------------------

    def next_due(self) -> float | None:
        """Return when `on_timer` has something to do, or None."""
        return self._policy.next_timer()

    def on_timer(self, now: float) -> None:
        """Make the calls that are due."""
        self._policy.handle_timer(now)
        self._act(now)

    def close(self) -> None:
        """Close all fallbacks."""
        self._loop.set_clients(())
        for fallback in self._fallbacks.values():
            fallback.server.close()
        self._fallbacks.clear()
        self._types.clear()
        self._up = frozenset()
