"""Offers a cloud's local services to robots, and runs the robots' requests on the local servers."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING

from plr.protos.model.members import ServiceOffer
from plr.sidecar.core.base.fair_share import Shares
from plr.sidecar.core.base.values import RejectReason
from plr.sidecar.core.rules.service_rule import Rules
from plr.sidecar.core.seam.application import AbandonExecution, CallsForbidden, CancelExecution, ExecuteRequest
from plr.sidecar.ros.cloud.roll_call import POLL_S, RollCall
from plr.sidecar.ros.cloud.server_processes import ServerProcesses
from plr.sidecar.ros.cloud.service_runner import PendingCall, ServiceRunner
from plr.sidecar.ros.errors import RosBridgeError
from plr.sidecar.ros.graph import graph
from plr.sidecar.ros.graph.node_names import NodeNames
from plr.sidecar.ros.types import TypeNotInstalledError, load_service_type

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator

    from plr.protos.model.ids import ServiceName
    from plr.sidecar.core.base.values import ExecutionId
    from plr.sidecar.core.rules.service_rule import ServiceRule
    from plr.sidecar.core.seam.application import ApplicationEvent
    from plr.sidecar.ports import DataPlane
    from plr.sidecar.ros.log_limit import LimitedLog
    from plr.sidecar.ros.ros_loop import RosLoop, Waited
    from plr.sidecar.ros.stats import BridgeStats

MAX_PENDING_CALLS = 4096
"""Requests at local servers or waiting for them; one robot may have half. Further ones are refused as OVERLOADED, so
that another server runs them."""
MAX_CARRIED_SERVICES = 512
"""Services of the local graph that are offered; each costs DDS endpoints and a slot in every wait."""
TYPE_RETRY_S = 30.0
"""How often a type that is not installed is tried again: someone may be installing it."""
SILENCE_S = 0.5
"""A server that answers nothing for this long is asked whether it lives."""
TRUSTED_S = 5.0
"""Longest time a heard server counts as alive, while its process is watched and no further request waits. It is long
because each call makes every ROS process of the domain send something."""
CHECK_EVERY_S = 0.25
"""How often that is checked while such a server has something to answer."""

log = logging.getLogger(__name__)


class CloudSide:
    """Offers local services to robots and runs their requests on the local servers."""

    def __init__(
        self,
        *,
        loop: RosLoop,
        rules: tuple[ServiceRule, ...],
        data_plane: DataPlane,
        stats: BridgeStats,
        limited_log: LimitedLog,
    ) -> None:
        self._loop = loop
        self._rules = Rules(rules)
        self._data_plane = data_plane
        self._stats = stats
        self._limited = limited_log
        self._runners: dict[ServiceName, ServiceRunner] = {}
        self._calls: dict[ExecutionId, tuple[ServiceRunner, PendingCall]] = {}
        self._shares = Shares(MAX_PENDING_CALLS)
        self._offers: tuple[ServiceOffer, ...] = ()
        self._missing_types: dict[ServiceName, str] = {}
        self._types_retried_at = 0.0
        self._several_servers: set[ServiceName] = set()
        self._several_types: set[ServiceName] = set()
        self._processes = ServerProcesses(loop.domain_id, lambda: graph.participants(loop.node), loop.wake)
        self._roll_call = RollCall(loop.node, self._processes.wants_processor)
        self._names = NodeNames(loop.node, stats, limited_log)
        self._at_work: set[ServiceRunner] = set()
        """Runners whose server has something to answer, or seems dead."""
        self._in_doubt: frozenset[ServiceRunner] = frozenset()
        """Runners at work whose server has been silent for so long that it must be heard to count as alive."""
        self._check_at = 0.0
        self.scan_is_due = False
        """Whether a scan of the graph is due although it has not changed."""
        self._paced: set[ServiceRunner] = set()
        """Runners with requests that wait for room at their server."""

    # -- what the data plane says ------------------------------------------------------------------------------

    def handle(self, event: ApplicationEvent, now: float) -> None:
        """Act on one event of the data plane."""
        match event:
            case ExecuteRequest():
                self._execute(event, now)
            case AbandonExecution():
                self._abandon(event)
            case CancelExecution():
                self._cancel(event)
            case CallsForbidden():
                log.warning(
                    "%s asks for %a, which the access policy does not let it call here: refused (%d times lately)",
                    event.robot,
                    event.service,
                    event.count,
                )
            case _:
                self._stats.dropped["event_for_other_role"] += 1

    def _execute(self, event: ExecuteRequest, now: float) -> None:
        runner = self._runners.get(event.service)
        if runner is None or not runner.server.is_usable(now):
            self.refuse(event, RejectReason.NOT_OFFERED, "no local server", now)
            return
        if runner.type.name != event.type:
            self.refuse(event, RejectReason.WRONG_TYPE, f"the type here is {runner.type.name}", now)
            return
        if not self._shares.fits(event.robot):
            why = f"{len(self._calls)} requests are running, {self._shares.held(event.robot)} of this robot"
            self.refuse(event, RejectReason.OVERLOADED, why, now)
            return
        try:
            request = runner.type.request.deserialize(event.payload)
        except RosBridgeError as error:
            self.refuse(event, RejectReason.BAD_PAYLOAD, str(error), now)
            return
        call = PendingCall(
            event.execution, event.robot, request, now, event.priority, now + event.deadline_s, now + event.expires_s
        )
        self._calls[event.execution] = (runner, call)
        self._shares.take(event.robot)
        self._stats.pending = len(self._calls)
        runner.add(call, now)
        self._release(runner, now)
        if runner.window.holds(call):
            self._stats.requests_paced += 1
            self._paced.add(runner)
        self._at_work.add(runner)
        self._stats.requests_sent[event.service] += 1

    def refuse(self, event: ExecuteRequest, reason: RejectReason, detail: str, now: float) -> None:
        """Tell the data plane that `event` was not run."""
        self._stats.refused[event.service, reason.name.lower()] += 1
        self._limited.log(
            logging.WARNING,
            (reason.name, event.service),
            now,
            "%s: request of %s refused, %s: %s",
            event.service,
            event.robot,
            reason.name.lower(),
            detail,
        )
        self._data_plane.refuse(event.execution, reason, detail)

    def _abandon(self, event: AbandonExecution) -> None:
        known = self._forget(event.execution)
        if known is None:
            self._stats.dropped["abandon_without_execution"] += 1
            return
        runner, call = known
        runner.abandon(call)
        self._paced.add(runner)  # there may be room now for waiting requests
        self._stats.abandoned[runner.name] += 1
        if event.awaited and call.number is None:
            why = "its time here was over before the server had room for it"
            self._data_plane.refuse(call.id, RejectReason.OVERLOADED, why)
        elif event.awaited:
            self._data_plane.refuse(call.id, RejectReason.SERVER_LOST, "the server did not answer in time")

    def _forget(self, execution: ExecutionId) -> tuple[ServiceRunner, PendingCall] | None:
        known = self._calls.pop(execution, None)
        if known is not None:
            self._shares.give_back(known[1].robot)
            self._stats.pending = len(self._calls)
        return known

    def _cancel(self, event: CancelExecution) -> None:
        """Drop a request that has not reached its server yet: the robot has its answer."""
        known = self._calls.get(event.execution)
        if known is None:
            return  # it was answered a moment ago
        runner, call = known
        if call.number is None:
            runner.abandon(call)
            self._refuse_calls([call], runner.name, RejectReason.CANCELLED, "called off")

    # -- what the local servers answer -----------------------------------------------------------------------------

    def take(self, entity: Waited, now: float) -> None:
        """Pass on the answers that have arrived from a server, and send what it has room for now."""
        if not isinstance(entity, ServiceRunner):
            return
        for call, payload in entity.take(now):
            if call is None:
                # Its request was abandoned, or two nodes serve one name and this is the second answer.
                self._stats.dropped["answer_without_execution"] += 1
            else:
                self._answered(entity, call, payload, now)
        self._release(entity, now)

    def _answered(self, runner: ServiceRunner, call: PendingCall, payload: bytes, now: float) -> None:
        self._forget(call.id)
        self._stats.answers_taken[runner.name] += 1
        if (server := runner.server.only) is not None and self._roll_call.answered(server, now):
            self.scan_is_due = True
        self._data_plane.complete(call.id, payload, now - call.arrived_at)

    def _release(self, runner: ServiceRunner, now: float) -> None:
        for call, why in runner.release(now):
            self._refuse_calls([call], runner.name, RejectReason.OVERLOADED, why)

    # -- what the graph shows ------------------------------------------------------------------------------------

    def settling(self) -> bool:
        """Return whether another scan of the graph should follow soon, even if it does not change."""
        return any(not runner.server.ready for runner in self._runners.values())

    def scan(self) -> Iterator[None]:
        """Compare the graph with the clients, in small steps; tell the data plane what is now offered."""
        self._names.begin_scan()
        served = yield from graph.scan(self._loop.node, self._names.name_of, self._is_in_rules, time.monotonic())
        self._stats.scans += 1
        now = time.monotonic()
        retry_types = now - self._types_retried_at >= TYPE_RETRY_S
        if retry_types:
            self._types_retried_at = now
        wanted = yield from self._wanted(served)
        for name in [name for name, runner in self._runners.items() if wanted.get(name) != runner.type.name]:
            self._close_runner(name, "its server is gone")
            yield
        for name in [name for name, kind in self._missing_types.items() if wanted.get(name) != kind]:
            del self._missing_types[name]
        for name, type_name in wanted.items():
            yield
            runner = self._runners.get(name)
            if runner is not None:
                self._scan_servers(runner, time.monotonic())
                self._notice_several_servers(runner, served[name].applications().get(type_name, frozenset()))
            elif retry_types or name not in self._missing_types:
                self._open_runner(name, type_name)
        yield
        self._names.end_scan()
        self._processes.forget_the_gone()
        self._roll_call.keep(graph.participants(self._loop.node))
        self._publish_state()

    def _is_in_rules(self, service: ServiceName) -> bool:
        return self._rules.find(service) is not None

    def _wanted(self, served: dict[ServiceName, graph.Served]) -> Generator[None, None, dict[ServiceName, str]]:
        """Return name -> type of the services that applications serve here and a rule carries."""
        wanted: dict[ServiceName, str] = {}
        for name, service in served.items():
            types = service.applications()
            if not types or not self._is_in_rules(name):
                continue
            runner = self._runners.get(name)
            used = None if runner is None else runner.type.name
            if len(types) > 1 or (runner is not None and (used not in types or runner.server.lost)):
                wanted[name] = self._choose_type(name, used, types)
            else:
                wanted[name] = min(types)
                self._several_types.discard(name)
            yield
        self._several_types &= wanted.keys()
        self._several_servers &= wanted.keys()
        return wanted

    def _choose_type(self, name: ServiceName, used: str | None, nodes: dict[str, frozenset[str]]) -> str:
        """Choose among several types of one service: the one in use stays while a server of it may live.

        `nodes` maps a type to the nodes that serve it. Of nodes that share a name, such as a dead server and its
        replacement, rmw shows the services of one only.
        """
        endpoints = graph.server_endpoints(self._loop.node, name, self._names.name_of, time.monotonic())
        living = set(nodes.keys() - endpoints.keys())  # rmw is not DDS, or the graph is just changing
        for kind, known in endpoints.items():
            for endpoint in known:
                self._processes.watch(endpoint)  # also those not in use: they may be chosen later
            # Silence is not enough: a server that hangs may have work, and resumes it.
            if any(is_known and not self._processes.has_ended(endpoint) for endpoint, is_known in known.items()):
                living.add(kind)
        candidates = living or nodes.keys()
        # If none is in use, the choice is at least the same every time.
        chosen = used if used is not None and used in candidates else min(candidates)
        if len(living) < 2:
            self._several_types.discard(name)
        elif name not in self._several_types:
            self._several_types.add(name)
            served = ", ".join(f"{kind} ({' '.join(sorted(nodes.get(kind, ()))) or '?'})" for kind in sorted(living))
            log.warning("service %s is served here with several types, %s: robots get %s", name, served, chosen)
        return chosen

    def _scan_servers(self, runner: ServiceRunner, now: float) -> None:
        """Scan a runner's servers; give up its calls if its server is gone, even if another replaced it."""
        if runner.server.scan(self._is_dead, now):
            log.warning("service %s: its server is gone or was replaced by another", runner.name)
            self._give_up_calls(runner, "the server was replaced")
        if runner.server.lost:
            self._at_work.add(runner)  # until it is heard again, or gone
        for endpoint in runner.server.endpoints:
            self._processes.watch(endpoint)

    def _notice_several_servers(self, runner: ServiceRunner, nodes: frozenset[str]) -> None:
        """Warn of several servers: ROS gives a request to all of a name, at most once each, so it runs repeatedly."""
        name = runner.name
        # Nodes may share a name, and some may be dead.
        servers = runner.server.living if runner.server.endpoints else len(nodes)
        if servers < 2:
            self._several_servers.discard(name)
        elif name not in self._several_servers:
            self._several_servers.add(name)
            log.warning(
                "service %s has %d servers here%s: each request runs on all of them, the first answer counts",
                name,
                servers,
                f" ({', '.join(sorted(nodes))})" if nodes else "",  # rmw may show only the other type for a node name
            )

    def _open_runner(self, name: ServiceName, type_name: str) -> None:
        if len(self._runners) >= MAX_CARRIED_SERVICES:
            self._stats.dropped["too_many_services"] += 1
            return
        try:
            runner = ServiceRunner(
                self._loop.node,
                name,
                load_service_type(type_name),
                self._is_alive_since,
                self._names.name_of,
            )
        except RosBridgeError as error:
            if name not in self._missing_types:
                self._missing_types[name] = type_name
                kind = "type_not_installed" if isinstance(error, TypeNotInstalledError) else "service_refused"
                self._stats.errors[kind] += 1
                log.error("service %s is not offered to robots: %s", name, error)
            return
        self._missing_types.pop(name, None)
        self._runners[name] = runner
        self._loop.set_clients(tuple(self._runners.values()))

    def _close_runner(self, name: ServiceName, why: str) -> None:
        runner = self._runners.pop(name)
        self._loop.set_clients(tuple(self._runners.values()))
        self._give_up_calls(runner, why)
        self._at_work.discard(runner)
        runner.close()
        log.info("service %s is no longer offered to robots: %s", name, why)

    def _give_up_calls(self, runner: ServiceRunner, why: str) -> None:
        sent, unsent = runner.take_back()
        self._paced.discard(runner)
        self._refuse_calls(sent, runner.name, RejectReason.SERVER_LOST, why)
        self._refuse_calls(unsent, runner.name, RejectReason.NOT_OFFERED, why)

    def _refuse_calls(self, calls: list[PendingCall], service: ServiceName, reason: RejectReason, detail: str) -> None:
        for call in calls:
            self._forget(call.id)
            self._stats.refused[service, reason.name.lower()] += 1
            self._data_plane.refuse(call.id, reason, detail)

    def _publish_state(self) -> None:
        ready = {name: runner for name, runner in self._runners.items() if runner.server.ready}
        self._stats.missing_types = dict(self._missing_types)
        self._stats.mismatched = frozenset(name for name, runner in self._runners.items() if runner.server.mismatched)
        self._stats.silent = frozenset(name for name, runner in self._runners.items() if runner.server.lost)
        offers = tuple(
            ServiceOffer(name, runner.type.name, rule.capacity, rule.cost_per_request)
            for name, runner in sorted(ready.items())
            if (rule := self._rules.find(name)) is not None
        )
        if offers == self._offers:
            return
        for offer in set(offers) - set(self._offers):
            log.info("service %s (%s) is offered to robots", offer.name, offer.type)
        self._offers = offers
        self._stats.carried = frozenset(offer.name for offer in offers)
        self._data_plane.set_offers(offers)

    # -- whether the servers live -----------------------------------------------------------------------------------

    def _is_dead(self, endpoint: bytes) -> bool:
        """Return whether the endpoint's process ended, or fell silent after it had been heard.

        A process that just started also answers nothing until it has found us, which takes seconds on a busy machine.
        """
        if self._processes.has_ended(endpoint):
            return True
        proved = self._roll_call.has_ever_heard(endpoint) or not self._processes.watches(endpoint)
        return proved and self._roll_call.is_silent(endpoint)

    def _is_alive_since(self, runner: ServiceRunner, since: float) -> bool:
        """Return whether one of its servers lives: its end would have been noticed, or it was heard since `since`.

        A process that was not seen to end may still hang: if it answers nothing, it is in doubt.
        """
        endpoints = runner.server.endpoints
        in_doubt = runner in self._in_doubt
        return not endpoints or any(
            (not in_doubt and self._processes.watches(endpoint)) or self._roll_call.has_heard(endpoint, since)
            for endpoint in endpoints
            if not self._processes.has_ended(endpoint)
        )

    def _notice_ends(self) -> None:
        """Give up what was handed to processes that ended; another server may run what still waits for them."""
        ended = self._processes.has_ended
        hit = [
            runner
            for runner in self._runners.values()
            # Servers that fell silent earlier were struck out then, but kept their requests.
            if runner.server.strike_out(ended) or (runner.pending and runner.server.is_over(ended))
        ]
        if hit:
            log.warning("the process of a server ended: %s", " ".join(sorted(runner.name for runner in hit)))
        for runner in hit:
            self._give_up_calls(runner, "the server's process ended")
        self._publish_state()
        self.scan_is_due = True  # for those of another type

    def _notice_silence(self) -> None:
        """Refuse what waits for servers that show no sign of life; what they already have may still be answered."""
        why = "the server shows no sign of life"
        hit = [runner for runner in self._runners.values() if runner.server.strike_out(self._is_dead)]
        if hit:
            log.warning("a server shows no sign of life: %s", " ".join(sorted(runner.name for runner in hit)))
        for runner in hit:
            self._at_work.add(runner)
            self._paced.discard(runner)
            self._refuse_calls(runner.take_back_unsent(), runner.name, RejectReason.NOT_OFFERED, why)
        self._publish_state()
        self.scan_is_due = True  # for those that are heard again

    def _endpoints_to_ask(self, now: float) -> list[bytes]:
        """Return the ids of servers whose silence may mean that they are dead, and of those found silent before."""
        self._at_work = {runner for runner in self._at_work if runner.silent_since is not None or runner.server.lost}
        self._in_doubt = frozenset(
            runner
            for runner in self._at_work
            if runner.server.lost or (runner.silent_since is not None and now - runner.silent_since >= SILENCE_S)
        )
        return [
            endpoint
            for runner in self._in_doubt
            for endpoint in runner.server.endpoints
            if self._is_to_be_asked(runner, endpoint, now)
        ]

    def _is_to_be_asked(self, runner: ServiceRunner, endpoint: bytes, now: float) -> bool:
        if self._processes.has_ended(endpoint):
            return False
        silent_since = runner.silent_since
        if silent_since is None or runner.server.lost or runner.window.waiting:
            return True
        if not self._processes.watches(endpoint):
            return True
        # Nothing waits, and its end would be noticed: ask more rarely the longer it has been at work.
        return not self._roll_call.has_heard(endpoint, now - min((now - silent_since) / 2.0, TRUSTED_S))

    # -- time ----------------------------------------------------------------------------------------------------

    def next_due(self) -> float | None:
        """Return when `on_timer` has something to do, or None."""
        dues = [due for runner in self._paced if (due := runner.window.next_due()) is not None]
        if self._at_work:
            dues.append(self._check_at)
        if (names_at := self._names.next_due()) is not None:
            dues.append(names_at)
        return min(dues, default=None)

    def on_timer(self, now: float) -> None:
        """Notice dead servers; send the requests that waited long enough for a server that answers nothing."""
        if self._processes.take_ended():
            self._notice_ends()
        if self._at_work and now >= self._check_at:
            if self._roll_call.turn(self._endpoints_to_ask(now), now):
                self._notice_silence()
            self._check_at = now + (POLL_S if self._roll_call.under_way else CHECK_EVERY_S)
            self._paced |= self._at_work  # a server that was heard may get more than it answers
        if self._names.turn(now):
            self.scan_is_due = True
        for runner in tuple(self._paced):
            due = runner.window.next_due()
            if due is None:
                self._paced.discard(runner)
            elif due <= now:
                self._release(runner, now)

    def close(self) -> None:
        """Withdraw all offers and refuse what is running."""
        self._offers = ()
        self._stats.carried = frozenset()
        self._data_plane.set_offers(())
        self._processes.close()
        self._roll_call.close()
        self._names.close()
        for name in tuple(self._runners):
            runner = self._runners.pop(name)
            sent, unsent = runner.take_back()
            # Those at the server may have run; another server may run the rest.
            self._refuse_calls(sent, name, RejectReason.SERVER_LOST, "the sidecar is shutting down")
            self._refuse_calls(unsent, name, RejectReason.DRAINING, "the sidecar is shutting down")
            runner.close()
        self._loop.set_clients(())
