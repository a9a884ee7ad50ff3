"""Drives the core: runs its timers, solves in a thread, and fills the streams. No protocol decisions here."""

from __future__ import annotations

import asyncio
import concurrent.futures
import logging
import time
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

from plr.controlplane.core.control.control import ControlCore, Settled
from plr.controlplane.core.control.events import (
    CutOffNotice,
    DepartureNotice,
    FaultNotice,
    NackNotice,
    OffersRefusedNotice,
    StreamLostNotice,
    UnmetNotice,
)
from plr.controlplane.core.overload.line_share import LineShare
from plr.controlplane.core.overload.report_share import ReportShares
from plr.controlplane.core.policy.permits import Permits
from plr.controlplane.core.policy.policy import OfferRule
from plr.controlplane.core.problem.plan import Plan
from plr.controlplane.core.problem.problem import Problem
from plr.controlplane.core.publish.messages import CloseReason, EndStream, SendMessage
from plr.controlplane.core.registry.credential_check import check_claims, check_unproven_claims
from plr.controlplane.core.registry.registry import Refusal
from plr.controlplane.garbage import Collector
from plr.controlplane.observe.fleet_metrics import MAX_GONE_WITH_SERIES, Fleet
from plr.controlplane.observe.remembered import departures
from plr.controlplane.serve.earliest_end import EarliestEnd
from plr.controlplane.serve.mailbox import Mailbox
from plr.controlplane.turns import Turns
from plr.protos.base.token_bucket import TokenBucket
from plr.protos.convert import status_to_proto
from plr.protos.model.fleet_events import EventKind, Why
from plr.protos.model.ids import Role
from plr.protos.model.members import NO_REVOCATIONS, RemovalReason, ServiceSet
from plr.protos.model.status import Fault
from plr.protos.trust.identity import EXPIRED, NOT_YET_VALID, REVOKED, CertificateError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from plr.controlplane.config.controlplane import ControlPlaneConfig
    from plr.controlplane.core.explain.departed import Departed
    from plr.controlplane.core.explain.explanation import Pairs
    from plr.controlplane.core.explain.fleet_view import MemberView
    from plr.controlplane.core.formulation.block import Picture
    from plr.controlplane.core.policy.policy import Policy
    from plr.controlplane.core.registry.registry import StreamId
    from plr.controlplane.observe.event_log import EventLog
    from plr.controlplane.observe.metrics import Metrics
    from plr.controlplane.serve.stun_server import StunServer
    from plr.controlplane.serve.tls_gate import Caller
    from plr.controlplane.solver.matcher import Matcher
    from plr.protos.model.explanation import Explanation
    from plr.protos.model.ids import NodeName, ServiceName
    from plr.protos.model.members import Registration, RevocationSet
    from plr.protos.model.stream import SidecarMessage
    from plr.protos.trust.identity import Trust

log = logging.getLogger(__name__)

MAX_SERVICES_LOGGED = 8
"""Services that one log line names at most."""

ENDED_LINES_BURST = 20.0
"""Burst of log lines, over all members, on streams ended for breaking the rules and on messages left out."""

CAPACITY_LINE_EVERY_S = 60.0
ENDED_LINES_PER_S = 1.0
"""Rate of these lines after the burst."""

METRICS_INTERVAL_S = 1.0
"""Maximum age of scraped values: Prometheus scrapes every few seconds at most."""

FLEET_TIMEOUT_S = 4.0
"""Longest wait for the views of all members: a scrape waits no longer, and Prometheus not much longer."""


URGENT_LIMIT_S = 0.1
"""Time limit of the solver when a mapping is urgent. What is not proven optimal by then waits for the next routine
solving, so a client that makes many mappings urgent does not delay it."""

URGENT_LIMIT_EACH_S = 250e-6
"""The same limit for large fleets, for each service of a robot: stating the problem alone takes a part of it."""


def wall_clock_epoch() -> int:
    """Return the version to start from: seconds since 1970, with room for 2^20 versions in each.

    It stays below 2^53, so that metrics (doubles) tell one version from the next.
    """
    return time.time_ns() // 1_000_000_000 << 20


def _few(services: Sequence[ServiceName]) -> str:
    more = len(services) - MAX_SERVICES_LOGGED
    return ", ".join(services[:MAX_SERVICES_LOGGED]) + (f" and {more} more" if more > 0 else "")


_FAULT_EVENTS = {Fault.FLAPPING: EventKind.FLAPPING, Fault.USELESS: EventKind.USELESS}


@dataclass(slots=True)
class Used:
    """Processor time of the loop's thread and the time when it was read, in seconds."""

    processor_s: float
    at: float

    def share(self, processor_s: float, now: float) -> float | None:
        """Return the share of one core used since the last call; None if that was a moment ago."""
        passed_s = now - self.at
        if passed_s < METRICS_INTERVAL_S / 2:
            return None
        share = (processor_s - self.processor_s) / passed_s
        self.processor_s, self.at = processor_s, now
        return share


QUIET_SHARE, QUIET_LOOKS = 0.5, 5
"""Share of one core, and how many times in a row the loop must use less before deferrable work begins."""


class _LateMatcher:
    """The matcher, for the solver's thread alone, imported late: after a restart no stream waits for its modules."""

    def __init__(self) -> None:
        self._matcher: Matcher | None = None

    @staticmethod
    def prepare() -> None:
        """Import the modules that few problems need."""
        from plr.controlplane.solver import cp_sat

        cp_sat.prepare()

    def solve(self, problem: Problem, time_limit_s: float, hint: Plan) -> Plan:
        from plr.controlplane.solver.matcher import Matcher

        if self._matcher is None:
            self._matcher = Matcher()
        return self._matcher.solve(problem, time_limit_s=time_limit_s, hint=hint)


class ControlLoop:
    """The core with its clock, its solver and the mailboxes of its streams."""

    def __init__(self, config: ControlPlaneConfig, metrics: Metrics, events: EventLog) -> None:
        self._loop = asyncio.get_running_loop()
        self._config = config
        self._metrics = metrics
        self.events = events
        now = self._loop.time()
        self._core = ControlCore(config.settings(), version_epoch=wall_clock_epoch(), now=now)
        before = departures(events.events(), ran_until=events.ran_until, now_wall=time.time(), now=now)
        self._core.remember(*before, now)
        self._mailboxes: dict[StreamId, Mailbox] = {}
        self._callers: dict[NodeName, Caller] = {}
        self._earliest_end = EarliestEnd()
        self._superseded = 0
        self.turns = Turns()
        """Turns for all long work."""
        self.revocations = NO_REVOCATIONS
        """The revocation lists in use here."""
        self._wake = asyncio.Event()
        self._ended_lines = TokenBucket(rate=ENDED_LINES_PER_S, burst=ENDED_LINES_BURST, now=self._loop.time())
        self._stopping = False
        self._closing = False
        """Whether streams end because the control plane stops."""
        self._matcher = _LateMatcher()
        self._quiet_looks = 0
        """Quiet measurements since the loop was last busy; at QUIET_LOOKS the solver is prepared."""
        self._executor = concurrent.futures.ThreadPoolExecutor(1, thread_name_prefix="solver")
        self._exceeded = 0
        """Interfaces beyond the capacities, as last logged."""
        self._exceeded_line_at = 0.0
        self._garbage = Collector()
        self.report_shares = ReportShares()
        self._lines = LineShare()
        self.stun_servers: list[StunServer] = []
        self.has_unread: Callable[[NodeName, float], bool] = lambda name, since: False
        """Tells whether data of a member has arrived that nobody can have read by the given time."""

    # ── for the streams ──

    def register(self, registration: Registration, caller: Caller | None) -> tuple[StreamId, Mailbox] | Refusal:
        """Begin a stream; return it with its mailbox, or the refusal. `caller` is None in insecure mode."""
        if caller is None:
            refusal = check_unproven_claims(registration)
        else:
            refusal = check_claims(registration, caller.identity, caller.certificate)
        result = self._core.register(registration, self._loop.time()) if refusal is None else self._core.refuse(refusal)
        if isinstance(result, Refusal):
            who = registration.name if caller is None else caller.identity.name
            self._tell_refused(who, result, result.value)
            return result
        if caller is not None:
            self._callers[registration.name] = caller
            self._earliest_end.note(caller.identity.not_after)
        self._say(
            logging.INFO,
            registration.name,
            "%s (%s, incarnation %d, software %s) connected",
            registration.name,
            registration.role.value,
            registration.incarnation,
            registration.software_version or "unknown",
        )
        self.events.record(
            EventKind.CONNECTED,
            registration.name,
            f"software {registration.software_version or 'unknown'}, incarnation {registration.incarnation}",
            role=registration.role,
        )
        mailbox = self._mailboxes[result] = Mailbox()
        self._dispatch()
        return result, mailbox

    def refuse(self, name: NodeName | None, refusal: Refusal, details: str) -> None:
        """Note a first message that is refused before anything is registered; `name` is who sent it, if known."""
        self._core.refuse(refusal)
        if name is not None:
            self._tell_refused(name, refusal, details)

    def _tell_refused(self, name: NodeName, refusal: Refusal, details: str) -> None:
        self.events.record_refusal(name, refusal.name, f"registration: {details}")

    async def prepare(self, message: SidecarMessage) -> None:
        """Look up in turns what the policy says of services not heard of before, ahead of `receive`."""
        permits = self._core.permits
        if isinstance(message, ServiceSet) and (new := permits.not_looked_up(offer.name for offer in message.offers)):
            async for _ in self.turns.each(new, permits.look_up):
                pass

    def receive(self, stream: StreamId, message: SidecarMessage) -> None:
        """Handle one message of a stream; raises DecodeError if it has no place there."""
        self._core.receive(stream, message, self._loop.time())
        self._dispatch()

    def disconnected(self, stream: StreamId) -> None:
        """Handle the end of a stream."""
        mailbox = self._mailboxes.pop(stream, None)
        if mailbox is not None:
            self._superseded += mailbox.superseded
        self._core.disconnected(stream, self._loop.time())
        self._dispatch()

    def names(self) -> list[NodeName]:
        """Return the names of all registered sidecars, sorted."""
        return sorted(sidecar.name for sidecar in self._core.registry)

    def status(self, name: NodeName, *, abridged: bool) -> bytes:
        """Return one registered sidecar as an encoded part of a GetStatusResponse; empty if it is not registered."""
        return status_to_proto(self._core.status(self._loop.time(), (name,), abridged=abridged)).SerializeToString()

    @property
    def departed(self) -> Departed:
        """The sidecars that are gone."""
        return self._core.departed

    def now(self) -> float:
        """Return the time of the core in monotonic seconds."""
        return self._loop.time()

    def ask_fleet(self) -> Fleet:
        """Return what is known of each member, for other threads; raises TimeoutError if the loop is busy or ended."""
        gathering = self.gather_fleet()
        try:
            future = asyncio.run_coroutine_threadsafe(gathering, self._loop)
        except RuntimeError as error:
            gathering.close()
            raise TimeoutError("the loop has ended") from error
        try:
            return future.result(FLEET_TIMEOUT_S)
        except concurrent.futures.CancelledError as error:
            raise TimeoutError("the loop ends") from error
        finally:
            future.cancel()

    async def gather_fleet(self) -> Fleet:
        """Return the same, on the loop, in turns."""
        views: list[MemberView | None] = []
        async for found in self.turns.each(self.names(), lambda name: self._core.view(name, self._loop.time())):
            views += found
        members = [view for view in views if view is not None]
        ends = {name: caller.identity.not_after for name, caller in self._callers.items()}
        now = self._loop.time()
        return Fleet(members, self._core.departed.told(now, MAX_GONE_WITH_SERIES), ends, now, time.time())

    def status_line(self) -> str:
        """Return the state in a few words, for `systemctl status`."""
        counts = Counter(sidecar.role for sidecar in self._core.registry)
        return f"sidecars connected: {counts[Role.ROBOT]} of robots, {counts[Role.CLOUD]} of clouds"

    def explain(self, robot: NodeName, service: ServiceName) -> tuple[Explanation, Pairs]:
        """Explain why requests go where they go; raises UnknownNameError if the robot or its service is unknown.

        Return the explanation without its pairs, and these, to be read in turns.
        """
        return self._core.explain_in_parts(robot, service, self._loop.time)

    async def set_policy(self, policy: Policy | None) -> None:
        """Put another policy into force, once it is applied to all members: in turns, as there may be many rules."""
        permits = await asyncio.to_thread(Permits, policy)
        async for _ in self.turns.each(permits.prepare(list(self._core.registry)), lambda _: None):
            pass
        rules = f"rules for calls {len(policy.calls)}, for offers {len(policy.offers)}" if policy else "none"
        self.events.record(EventKind.POLICY, text=rules)
        self._core.set_permits(permits, self._loop.time())
        self._dispatch()

    def _dispatch(self) -> None:
        while (event := self._core.next_event()) is not None:
            match event:
                case SendMessage(stream=stream, message=message):
                    if stream in self._mailboxes:
                        self._mailboxes[stream].put(message)
                case EndStream(stream=stream, reason=reason):
                    if stream in self._mailboxes:
                        self._mailboxes[stream].close(reason)
                case NackNotice(sidecar=name, nack=nack):
                    self._say(
                        logging.WARNING,
                        name,
                        "%s refuses its %s and keeps version %d: %s",
                        name,
                        nack.resource.value,
                        nack.version,
                        nack.error,
                    )
                    self._record(EventKind.NACK, name, f"{nack.resource.value}: {nack.error}")
                case OffersRefusedNotice(sidecar=name, services=services):
                    self._say(
                        logging.WARNING,
                        name,
                        "%s offers %s, which the policy does not allow: no robot is told; missing under offers: %s",
                        name,
                        _few(services),
                        OfferRule((name,), services[:MAX_SERVICES_LOGGED]),
                    )
                    self._record(EventKind.OFFERS_REFUSED, name, _few(services))
                case UnmetNotice(sidecar=name, services=services):
                    self._record(EventKind.UNMET, name, _few(services))
                case DepartureNotice(sidecar=name, departure=gone):
                    self._say(logging.INFO, name, "%s is gone: %s", name, gone.why.value)
                    seen_s = max(0.0, self._loop.time() - gone.seen_at)
                    self.events.record(EventKind.DEPARTED, name, gone.text, role=gone.role, why=gone.why, seen_s=seen_s)
                    self._callers.pop(name, None)
                case StreamLostNotice(sidecar=name, role=role) if not self._closing:
                    self.events.record(EventKind.STREAM_LOST, name, role=role)
                case FaultNotice(sidecar=name, found=found, over=over):
                    kind = EventKind.RECOVERED if over else _FAULT_EVENTS[found.fault]
                    what = f" is no longer {found.fault.value}" if over else f": {found.text}"
                    text = f"{found.interface}{what}"
                    self._say(logging.INFO if over else logging.WARNING, name, "%s: %s: %s", name, kind.value, text)
                    self._record(kind, name, text)
                case CutOffNotice(sidecar=name, role=role, lifted=lifted):
                    self._say(
                        logging.INFO if lifted else logging.WARNING,
                        name,
                        "%s: the policy lets it talk to %s",
                        name,
                        "somebody" if lifted else "nobody",
                    )
                    self.events.record(EventKind.REJOINED if lifted else EventKind.CUT_OFF, name, role=role)
        self._wake.set()

    def _say(self, level: int, member: str, text: str, *values: object, of_all: TokenBucket | None = None) -> None:
        """Log a line that a member can cause at will, within its share of lines and that of all members."""
        left_out = self._lines.take(member, self._loop.time(), of_all)
        if left_out:
            text, values = f"{text} (%d earlier lines about it were left out)", (*values, left_out)
        if left_out is not None:
            log.log(level, text, *values)

    def _record(self, kind: EventKind, name: NodeName, text: str) -> None:
        sidecar = self._core.registry.get(name)
        self.events.record(kind, name, text, role=sidecar.role if sidecar is not None else None)

    # ── for the watch on certificates ──

    def serials(self) -> list[tuple[NodeName, int]]:
        """Return the members that have proved their identity, with the serial numbers of their certificates."""
        return [(name, caller.identity.serial) for name, caller in self._callers.items()]

    def review(self, name: NodeName, trust: Trust, now_wall: float) -> None:
        """Part with a sidecar whose certificate is no longer valid; `now_wall` is seconds since 1970."""
        caller = self._callers.get(name)
        if caller is None:
            return
        try:
            trust.check(caller.certificate, now_wall)
        except CertificateError as error:
            self._part_with(name, error)
            self._dispatch()

    def relay_revocations(self, crl: bytes, held: RevocationSet) -> None:
        """Send every present and future sidecar the revocation lists (PEM), and tell the operator which these are."""
        self.revocations = held
        self._core.relay_revocations(crl, self._loop.time())
        self._dispatch()

    def ended(self, now_wall: float) -> list[NodeName]:
        """Return the members whose certificates have expired."""
        in_use = ((name, caller.identity.not_after) for name, caller in self._callers.items())
        return self._earliest_end.ended(in_use, now_wall)

    def refused_member(self, name: NodeName, error: CertificateError) -> None:
        """Record that a member's connection was refused."""
        self.events.record_refusal(name, error.reason, f"connection: {error}")
        why = Why.REVOKED if error.reason == REVOKED else Why.CERTIFICATE_EXPIRED
        if error.reason in {REVOKED, EXPIRED, NOT_YET_VALID}:
            self._core.note_refused(name, why, str(error))

    def _part_with(self, name: NodeName, error: CertificateError) -> None:
        del self._callers[name]
        log.warning("%s: %s", name, error)
        if error.reason == REVOKED:
            self._core.part_with(name, RemovalReason.REVOKED, self._loop.time())
        elif error.reason == EXPIRED:
            self._core.part_with(name, RemovalReason.EXPIRED, self._loop.time())
        else:
            self._core.end_stream(name, CloseReason.CERTIFICATE_ENDED, self._loop.time())

    def refused(self, reason: str) -> None:
        """Count a connection or call that was refused or ended, by one of metrics.REFUSAL_REASONS."""
        self._metrics.refused_connection(reason)

    def unknown_message(self, who: str, problem: str, *, again: bool) -> None:
        """Count a message that was left out; `again` means the stream already has a log line about one."""
        self._metrics.unknown_messages.inc()
        if not again:
            self._say(logging.INFO, who, "stream of %s: left out %s", who, problem, of_all=self._ended_lines)

    def stream_ended(self, who: str, address: str, code: str, details: str) -> None:
        """Count and log a stream that we ended; `who` is the member, or else its `address`, where it came from."""
        self._metrics.streams_ended.labels(code).inc()
        # A member that keeps breaking the rules must not fill the disk; the counter shows how often it did.
        self._say(
            logging.WARNING,
            who,
            "stream of %s ended: %s: %s",
            address if who == address else f"{who} at {address}",
            code,
            details,
            of_all=self._ended_lines,
        )

    # ── the loop ──

    async def run(self) -> None:
        """Run until `stop`."""
        metrics_at = self._loop.time()
        used = Used(time.thread_time(), metrics_at)
        self._executor.submit(self._matcher.solve, Problem(()), 0.0, Plan({}))
        async with asyncio.TaskGroup() as solving:
            while not self._stopping:
                now = self._loop.time()
                self._wake.clear()
                self._core.handle_timer(now, self._unread(now))
                picture = self._core.start_solving(now)
                if picture is not None:
                    solving.create_task(self._solve(picture))
                drawn_s = self._loop.time() - now
                if now >= metrics_at:
                    share = used.share(time.thread_time(), now)
                    self._core.follow_load(now, share)
                    if share is not None:
                        self.report_shares.follow(share, now)
                    self._prepare_if_quiet(share)
                    self.events.keep_held()
                    self.update_metrics()
                    self._garbage.look_if_worth(len(self._core.registry))
                    metrics_at = now + METRICS_INTERVAL_S
                self._dispatch_quietly()
                self._garbage.set_aside(now)
                # Work spread over several turns takes half of the loop's time at most: streams have the other half.
                next_at = max(self._core.next_timer() or metrics_at, self._loop.time() + drawn_s)
                await self._sleep_until(min(metrics_at, next_at))
        self._executor.shutdown()

    def _unread(self, now: float) -> set[NodeName]:
        """Return the members with an ended lease whose bytes have arrived: a late loop must cost nobody the lease."""
        registry = self._core.registry
        return {name for name in registry.due(now) if self.has_unread(name, registry.heard_at(name, now))}

    def _prepare_if_quiet(self, share: float | None) -> None:
        """Prepare the solver once the loop is quiet: right after a start a returning fleet needs the processor."""
        if share is None or self._quiet_looks >= QUIET_LOOKS:
            return
        self._quiet_looks = self._quiet_looks + 1 if share < QUIET_SHARE else 0
        if self._quiet_looks == QUIET_LOOKS:
            self._executor.submit(self._matcher.prepare)

    def _dispatch_quietly(self) -> None:
        """Dispatch what the loop itself caused, without waking it again."""
        self._dispatch()
        self._wake.clear()

    async def _sleep_until(self, when: float) -> None:
        try:
            async with asyncio.timeout_at(when):
                await self._wake.wait()
        except TimeoutError:
            return

    async def _solve(self, picture: Picture) -> None:
        began = time.monotonic()
        try:
            settled = await self._loop.run_in_executor(self._executor, self._solve_and_settle, picture)
        except Exception:
            # The plan stays in force; one failed solving must not take the streams down.
            log.exception("solving failed; the current plan stays in force")
            self._core.solving_failed(self._loop.time())
            return
        self._metrics.solve_duration.observe(time.monotonic() - began)
        self._core.solved(settled, self._loop.time())
        self._tell_of_capacities()
        self._dispatch()

    def _tell_of_capacities(self) -> None:
        """Log exceeded capacities at a limited rate: in a changing fleet the figure differs after each solving."""
        exceeded, now = self._core.plan.relaxed, self._loop.time()
        if exceeded != self._exceeded and now >= self._exceeded_line_at:
            self._exceeded, self._exceeded_line_at = exceeded, now + CAPACITY_LINE_EVERY_S
            log.warning("capacities are exceeded by %d interfaces in all", exceeded)

    def _solve_and_settle(self, picture: Picture) -> Settled:
        """Solve and settle, on the solver's thread."""
        limit_s = self._config.solver_time_limit_ms / 1000
        if not self._core.solves_routinely:
            limit_s = min(limit_s, max(URGENT_LIMIT_S, URGENT_LIMIT_EACH_S * len(picture.problem.blocks)))
        plan = self._matcher.solve(picture.problem, limit_s, self._core.plan)
        return self._core.settle(picture, plan, self._loop.time())

    def update_metrics(self) -> None:
        """Publish the current values for the next scrape."""
        superseded = self._superseded + sum(mailbox.superseded for mailbox in self._mailboxes.values())
        self._metrics.update(self._core, self.stun_servers, superseded, self.events.state, self._dropped())

    def _dropped(self) -> dict[str, int]:
        """Return what the driver itself left out or put off, by reason."""
        return {
            "report_slowed": self.report_shares.slowed,
            "log_line_left_out": self._lines.left_out,
            "share_forgotten": self._core.shares_forgotten
            + self.report_shares.members.forgotten
            + self._lines.shares.forgotten,
        }

    def close_streams(self) -> None:
        """Tell every stream that the control plane is stopping."""
        self._closing = True
        for mailbox in self._mailboxes.values():
            mailbox.close(CloseReason.STOPPING)

    def stop(self) -> None:
        """End `run`."""
        self._stopping = True
        self._wake.set()
