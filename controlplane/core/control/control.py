"""Runs the control plane without IO: messages of sidecars and time in, messages and closings of streams out.

A driver calls `register`, `receive` and `disconnected` as streams begin, speak and end, `handle_timer` when
`next_timer` says so, and `start_solving`, `settle` and `solved` around the solver, which may run elsewhere meanwhile.
After each call it drains `next_event`. Times are monotonic seconds.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, assert_never

from plr.controlplane.core.control.events import (
    Counters,
    CutOffNotice,
    DepartureNotice,
    Event,
    FaultNotice,
    NackNotice,
    OffersRefusedNotice,
    Settings,
    StreamLostNotice,
    UnmetNotice,
)
from plr.controlplane.core.control.schedule import Change, Debounce
from plr.controlplane.core.estimate.estimator import Estimator
from plr.controlplane.core.estimate.reached import Reached
from plr.controlplane.core.estimate.unanswered import Unanswered
from plr.controlplane.core.explain.departed import Departed, Departure, departure, last_known, why_removed
from plr.controlplane.core.explain.departed_explanation import explain_departed
from plr.controlplane.core.explain.explanation import explain, find, whole
from plr.controlplane.core.explain.faults import Faults
from plr.controlplane.core.explain.fleet_view import MemberView, view_of
from plr.controlplane.core.explain.returning import Returning
from plr.controlplane.core.explain.status import is_met, is_offered, statuses
from plr.controlplane.core.formulation.block import Picture, interfaces_of
from plr.controlplane.core.formulation.problem_builder import MAX_CONSIDERED_INTERFACES, Drawing
from plr.controlplane.core.overload.pacing import Pacing
from plr.controlplane.core.overload.urgency import Urgency
from plr.controlplane.core.policy.cut_off import cut_off
from plr.controlplane.core.policy.permits import Permits
from plr.controlplane.core.policy.refused_offers import RefusedOffers
from plr.controlplane.core.policy.report_filter import believable
from plr.controlplane.core.problem.plan import Plan
from plr.controlplane.core.problem.problem import BlockKey, Problem
from plr.controlplane.core.publish.history import MappingHistory
from plr.controlplane.core.publish.mappings import changed_robots
from plr.controlplane.core.publish.messages import CloseReason, EndStream, SendMessage
from plr.controlplane.core.publish.publisher import Publisher
from plr.controlplane.core.registry.registry import AcceptedRegistration, Refusal, Registry, StreamId
from plr.controlplane.core.registry.restlessness import Restlessness
from plr.controlplane.core.settle.explored_pair import ExploredPairs
from plr.controlplane.core.settle.stability import Stability
from plr.protos.base.errors import DecodeError
from plr.protos.model.fleet_events import Why
from plr.protos.model.ids import Role
from plr.protos.model.mapping import MappingSet
from plr.protos.model.members import CandidateSet, Registration, RemovalReason, RevocationSet, ServiceSet
from plr.protos.model.report import Report
from plr.protos.model.stream import Ack, Drain, Heartbeat, Nack, ResourceKind, Welcome

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Set

    from plr.controlplane.core.explain.explanation import Pairs
    from plr.controlplane.core.policy.policy import Policy
    from plr.controlplane.core.registry.registry import Sidecar
    from plr.protos.model.explanation import Explanation
    from plr.protos.model.ids import NodeName, ServiceName
    from plr.protos.model.status import SidecarStatus, SyncState
    from plr.protos.model.stream import SidecarMessage

RESTLESS_DELAY_S = 1.0
"""Delay of publication for a member that comes and goes beyond its share."""

PUBLISH_DELAY_S = 0.02
"""Delay from a change of the members to the sets that announce it: a sidecar announces its addresses and its services
in two messages, and these should make one version."""


PUBLISH_DELAY_EACH_S = 50e-6
"""Additional delay for each sidecar: examining one for news takes some tenth of it."""

PUBLISHED_AT_ONCE = 200
"""Sidecars examined for news in one go: some milliseconds, for which streams wait. One with many peers counts for
more."""

TOLD_AT_ONCE = 64
"""Sidecars that are sent a new revocation list in one go."""

JUDGED_AT_ONCE = 32
"""Sidecars of which the operator is told in one go what a new policy denies them."""

_CLOSED_FOR = {
    RemovalReason.REVOKED: CloseReason.REVOKED,
    RemovalReason.EXPIRED: CloseReason.CERTIFICATE_ENDED,
}


@dataclass(frozen=True, slots=True)
class Settled:
    """What is to be in force, and for which robots that may be news."""

    picture: Picture
    plan: Plan
    robots: Set[NodeName]
    unproven: int
    """Groups of the solver's answer that are not proven to be the best."""


class ControlCore:
    """Combines registry, estimator, plan and snapshots."""

    def __init__(self, settings: Settings, *, version_epoch: int, now: float) -> None:
        self._settings = settings
        self.pacing = Pacing(interval_s=settings.report_interval_s, lease_s=settings.lease_s)
        self.registry = Registry(lease_s=settings.lease_s)
        self._told_intervals: dict[NodeName, float] = {}
        self.estimator = Estimator(half_life_s=settings.half_life_s)
        self.permits = Permits(settings.policy)
        self.counters = Counters()
        self.plan = Plan({})
        self._picture = Picture(Problem(()))
        self._drawing = Drawing(
            default_capacity_interfaces=settings.default_capacity_interfaces,
            objective=settings.objective,
            path_rules=settings.path_rules,
        )
        self._drawing_since: float | None = None
        """When the drawing of the next problem began, None while none is drawn."""
        self.solves_routinely = False
        """Whether the problem last returned by `start_solving` may take its time: nothing urgent waits for it."""
        self._debounce = Debounce()
        self._stability = Stability()
        self.history = MappingHistory()
        self.departed = Departed()
        self._returning = Returning()
        self._exploration = ExploredPairs()
        warm_until = now + settings.warm_up_s if settings.warm_up_s else None
        self._publisher = Publisher(self.registry, version_epoch=version_epoch, warm_until=warm_until)
        self._streams: dict[StreamId, NodeName] = {}
        self._last_stream = 0
        self._crl = b""
        self._untold: deque[NodeName] = deque()
        """Sidecars that do not have it yet."""
        self._untold_since = now
        self._unjudged: deque[tuple[NodeName, bool | None]] = deque()
        """Sidecars to tell the operator of: whether the policy cuts them off now or no longer; None: what it lets them
        not offer."""
        self._unjudged_since = now
        self._refused_offers = RefusedOffers()
        self.restlessness = Restlessness()
        self.urgency = Urgency()
        self.reached = Reached()
        self.unanswered = Unanswered()
        self.faults = Faults()
        self._publish_at: float | None = None
        self._publications: deque[Iterator[SendMessage | None]] = deque()
        """Publications begun, and told to some; the first one continues first."""
        self._publishing_since = now
        self._events: deque[Event] = deque()

    # ── streams ──

    def register(self, registration: Registration, now: float) -> StreamId | Refusal:
        """Begin a stream with this registration; return its number, or why it is refused."""
        stream = StreamId(self._last_stream + 1)
        before = self.registry.get(registration.name)
        result = self.registry.register(registration, stream, now)
        if not isinstance(result, AcceptedRegistration):
            return result
        self._last_stream = stream
        name = registration.name
        self.restlessness.forget(name)
        self._returning.is_back(name)
        gone = self.departed.get(name)
        if gone is not None and gone.why is not Why.POLICY:
            self.departed.forget(name)
        self._close(result.replaced, CloseReason.REPLACED, now)
        self._streams[stream] = name
        if result.new_run:
            self._forget_paths(name)
            self._begin_serving(name)
        self._tell_again(name, before, now)
        self._publisher.begin_stream(registration)
        self._welcome(name, stream)
        self._came_or_went(name, registration.role, now)
        self.follow_load(now)
        return stream

    def receive(self, stream: StreamId, message: SidecarMessage, now: float) -> None:
        """Take one message of a stream. Raise DecodeError on one that has no place there."""
        name = self._streams.get(stream)
        if name is None or not self.registry.touch(name, stream, now):
            self.counters.old_stream_messages += 1
            return
        if self.pacing.worth_telling(self._told_intervals[name], now):
            # Along with what is said anyway: telling all of them at once would hold up everything else.
            self._welcome(name, stream)
        match message:
            case Registration():
                raise DecodeError("a second registration on one stream")
            case CandidateSet() | ServiceSet():
                told = self._sayable(name, message)
                if self.restlessness.admits(name, stream, told, self._told_bytes(name, (told,)), now):
                    self._announced(name, told, now)
            case Report():
                self._receive_report(name, message, now)
            case Ack():
                self._receive_ack(name, message)
            case Nack():
                self._receive_nack(name, message, now)
            case Drain():
                sidecar = self.registry.get(name)
                if sidecar is not None and self.registry.set_draining(name):
                    self.restlessness.tell(name, sidecar.told_bytes, now)
                    self._publisher.changed(name, sidecar.role)
                    self._came_or_went(name, sidecar.role, now)
            case RevocationSet():
                self.registry.set_revocations(name, message)
            case Heartbeat():
                pass
            case _:
                assert_never(message)

    def _sayable(self, name: NodeName, told: CandidateSet | ServiceSet) -> CandidateSet | ServiceSet:
        """Return what a member announces, without a robot's offers: nobody calls robots."""
        sidecar = self.registry.get(name)
        if isinstance(told, ServiceSet) and told.offers and sidecar is not None and sidecar.role is Role.ROBOT:
            self.counters.robot_offers_ignored += len(told.offers)
            return replace(told, offers=())
        return told

    def _told_bytes(self, name: NodeName, told: Iterable[CandidateSet | ServiceSet]) -> int:
        """Return how many bytes about a member each listener is sent if it announces this; 0 if it is no news."""
        known = self.registry.get(name)
        if known is None:
            return 0
        after = known
        for one in told:
            after = after.having_said(one)
        return 0 if known.ready and after.as_peer() == known.as_peer() else after.told_bytes

    def _tell_again(self, name: NodeName, before: Sidecar | None, now: float) -> None:
        """Note that a member has registered: others are told what it said before, if that is within its share."""
        sidecar = self.registry.get(name)
        if sidecar is None or before is None or sidecar.as_peer() == before.as_peer():
            return
        if self.restlessness.may_tell(name, sidecar.told_bytes, now):
            self.restlessness.tell(name, sidecar.told_bytes, now)
        else:
            self.registry.unsay(name)

    def _announced(self, name: NodeName, told: CandidateSet | ServiceSet, now: float) -> None:
        if isinstance(told, CandidateSet):
            known = self.registry.get(name)
            changed = self.registry.set_candidates(name, told)
            self._note_links(name, known, now)
            if changed:
                interfaces = len({candidate.interface for candidate in told.candidates})
                self.counters.interfaces_left_out += max(0, interfaces - MAX_CONSIDERED_INTERFACES)
        else:
            known = self.registry.get(name)
            if told.unmet and known is not None and told.unmet != known.unmet:
                self._events.append(UnmetNotice(name, told.unmet))
            changed = self.registry.set_services(name, told)
            offered = {one.name for one in known.offers} if known is not None else set()
            self.unanswered.begin(name, offered ^ {one.name for one in told.offers})
        sidecar = self.registry.get(name)
        if changed and sidecar is not None:
            self._publisher.changed(name, sidecar.role)
            self._members_changed(now, sidecar.role)
            if isinstance(told, ServiceSet):
                self._note_refused_offers(name)

    def _note_links(self, name: NodeName, before: Sidecar | None, now: float) -> None:
        """Note which interfaces a robot announces that it did not before, or no longer."""
        sidecar = self.registry.get(name)
        if sidecar is None or before is None or before.candidates is None or sidecar.role is not Role.ROBOT:
            return
        if changed := set(interfaces_of(before)) ^ set(interfaces_of(sidecar)):
            self.faults.note_links(name, sorted(changed), now)

    def _receive_report(self, name: NodeName, report: Report, now: float) -> None:
        sidecar = self.registry.get(name)
        if sidecar is None or sidecar.role is not Role.ROBOT:
            self.counters.reports_ignored += 1
            return
        self._note_goodbyes(name, report.goodbyes)
        # This comes first: after a restart a robot reports on servers that are not back yet.
        reaches_again = not (report.more or report.changes_only) and self._publisher.waits_for(
            name, report.servers_before.union(path.server for path in report.paths)
        )
        report, left_out = believable(report, name, self.registry, self.permits)
        self.counters.reports += not report.continues
        self.counters.report_entries_forbidden += left_out
        for path in report.paths:
            if path.up:
                self.reached.note(name, path.server)
        self.unanswered.note(name, report.latencies, now)
        surprised = self._drawing.reported(name, report)
        change = Change.MISSES if surprised else Change.REPORT
        if self.estimator.merge(name, report, now):
            change = Change.PATH
        if change is not Change.REPORT:
            if self._drawing.is_urgent(name) or self.urgency.take(name, self._drawing.cost(name), now):
                self._drawing.robot_changed(name, estimate_again=surprised)
            else:
                change = Change.REPORT
        self._debounce.note(change, now)
        if not (report.more or report.changes_only) and self.faults.is_due(name, now):
            self._look_for_faults(sidecar, now)
        if reaches_again:
            self._publish_soon(now)

    def _look_for_faults(self, robot: Sidecar, now: float) -> None:
        name = robot.name
        announced = set(interfaces_of(robot))
        there: dict[NodeName, bool] = {}
        for server in {server for _, server in self.estimator.path_states(name)}:
            there[server] = is_met(name, server, self.registry, self.permits)
        paths = {
            (interface, server): path
            for (interface, server), path in self.estimator.path_states(name).items()
            if interface in announced and there[server]
        }
        blocks = self._drawing.blocks(name, (use.name for use in robot.uses))
        for one in self.faults.look(name, paths, blocks, now):
            self._events.append(FaultNotice(name, one.found, one.over))

    def _note_goodbyes(self, robot: NodeName, servers: Iterable[NodeName]) -> None:
        """Take what a robot knows of servers that left while the control plane was away, and that it may call."""
        could_say = None
        for name in servers:
            if not self.permits.may_know(robot, name):
                self.counters.report_entries_forbidden += 1
                continue
            gone = self.departed.get(name)
            if self._returning.said_goodbye(name, robot) and gone is not None:
                could_say = could_say or self._could_say()
                judged = self._returning.judged(gone, could_say)
                self.departed.note(judged)
                if judged.why is not gone.why:
                    self._events.append(DepartureNotice(name, judged))

    def _could_say(self) -> Callable[[NodeName], int]:
        """Return a function that counts the present robots that may call a server."""
        groups = Counter(self.permits.group(one.name) for one in self.registry if one.role is Role.ROBOT)
        may_know = self.permits.group_may_know
        return lambda server: sum(count for group, count in groups.items() if may_know(group, server))

    def _receive_ack(self, name: NodeName, ack: Ack) -> None:
        if self._publisher.acked(name, ack):
            self.counters.acks[ack.resource] += 1
        else:
            self.counters.stale_answers += 1

    def _receive_nack(self, name: NodeName, nack: Nack, now: float) -> None:
        if not self._publisher.nacked(name, nack, now):
            self.counters.stale_answers += 1
            return
        self.counters.nacks[nack.resource] += 1
        if self._publisher.is_due(name):
            self._publish_soon(now)
        if not self._publisher[name].track(nack.resource).refused_as_before:
            self._events.append(NackNotice(name, nack))

    def _welcome(self, name: NodeName, stream: StreamId) -> None:
        interval_s = self.pacing.interval_s
        self.registry.tell_lease(name)
        self._told_intervals[name] = interval_s
        welcome = Welcome(
            self.registry.lease_s, interval_s, self._settings.stun_servers, self._crl, self.pacing.reconnect_max_s
        )
        self._events.append(SendMessage(stream, welcome))

    def follow_load(self, now: float, busy: float | None = None) -> None:
        """Let sidecars report as often as their number and `busy` allow: the share of one core used recently.

        After a restart, those still to come back count too: so each is told its interval once.
        """
        self.pacing.follow(len(self.registry) + len(self._returning), now, busy)
        self.registry.lease_s = self.pacing.lease_s

    def relay_revocations(self, crl: bytes, now: float) -> None:
        """Pass this list (PEM) on to all: a sidecar may know peers that this run does not know."""
        if crl == self._crl:
            return
        self._crl = crl
        # Sidecars that come from now on are told in their own welcome.
        self._untold = deque(sidecar.name for sidecar in self.registry)
        self._untold_since = now
        self._tell_revocations()

    def _tell_revocations(self) -> None:
        """Tell some of those without the list; `next_timer` is past until all have been told."""
        for _ in range(min(TOLD_AT_ONCE, len(self._untold))):
            sidecar = self.registry.get(self._untold.popleft())
            if sidecar is not None and sidecar.stream is not None:
                self._welcome(sidecar.name, sidecar.stream)

    def refuse(self, refusal: Refusal) -> Refusal:
        """Count a registration that the driver refuses; return its reason."""
        self.registry.counters.refused[refusal] += 1
        return refusal

    def part_with(self, name: NodeName, reason: RemovalReason, now: float) -> None:
        """Remove a sidecar that must not be talked to any more. Its peers are told so from now on, some with each call
        of `handle_timer`."""
        sidecar = self.registry.remove(name, reason)
        if sidecar is None:
            return
        self._close(sidecar.stream, _CLOSED_FOR[reason], now)
        self._forget(sidecar, reason, now)
        self._drawing.members_changed()
        self._debounce.note(Change.MEMBERS, now)
        self._publish_at = now

    def end_stream(self, name: NodeName, reason: CloseReason, now: float) -> None:
        """End a sidecar's stream; unless it was about to leave, it stays registered until its lease ends."""
        sidecar = self.registry.get(name)
        if sidecar is not None:
            self._close(sidecar.stream, reason, now)

    def _close(self, stream: StreamId | None, reason: CloseReason, now: float) -> None:
        """End a stream, if there is one; it has ended at once, not when the driver has carried that out."""
        if stream is not None:
            self._events.append(EndStream(stream, reason))
            self.disconnected(stream, now)

    def disconnected(self, stream: StreamId, now: float) -> None:
        """Note that a stream ended, whoever ended it: the only way one does. Ignore one that had ended before."""
        name = self._streams.pop(stream, None)
        sidecar = self.registry.get(name) if name is not None else None
        if name is None or sidecar is None:
            return
        if self.registry.disconnect(name, stream) is not None:
            self._forget(sidecar, RemovalReason.LEFT, now)
            self._came_or_went(name, sidecar.role, now)
        elif sidecar.stream == stream:
            self._events.append(StreamLostNotice(name, sidecar.role))

    # ── policy ──

    def set_policy(self, policy: Policy | None, now: float) -> None:
        """Put another policy in force: everybody is told what changes for them."""
        self.set_permits(Permits(policy), now)

    def set_permits(self, permits: Permits, now: float) -> None:
        """Do the same with permits that were prepared for the members: this takes a fraction of the time."""
        before = cut_off(self.registry, self.permits)
        self.permits = permits
        after = cut_off(self.registry, permits)
        self._refused_offers.clear()
        self._unjudged.extend((name, name in after) for name in sorted(before ^ after))
        self._unjudged.extend((sidecar.name, None) for sidecar in self.registry if sidecar.offers)
        self._unjudged_since = now
        self._judge(now)
        self._publisher.all_changed()
        self._members_changed(now)

    def _judge(self, now: float) -> None:
        """Tell of some of those that a policy denies something; `next_timer` is past until all are told of."""
        for _ in range(min(JUDGED_AT_ONCE, len(self._unjudged))):
            name, alone = self._unjudged.popleft()
            if alone is None:
                self._note_refused_offers(name)
            else:
                self._note_cut_off(name, now, lifted=not alone)

    def _note_cut_off(self, name: NodeName, now: float, *, lifted: bool) -> None:
        sidecar = self.registry.get(name)
        if sidecar is None:
            return
        if lifted:
            self.departed.forget(name)
        else:
            text = "connected, but the policy lets it talk to nobody; try: plr policy check"
            self.departed.note(self._departure(sidecar, Why.POLICY, text, now))
        self._events.append(CutOffNotice(name, sidecar.role, lifted))

    def _note_refused_offers(self, name: NodeName) -> None:
        sidecar = self.registry.get(name)
        if sidecar is None:
            return
        refused = self.permits.refused_offers(sidecar)
        new, untold = self._refused_offers.update(name, refused)
        self.counters.offers_refused += new
        if untold:
            self._events.append(OffersRefusedNotice(name, untold))

    # ── time ──

    def next_timer(self) -> float | None:
        """Return when to call `handle_timer` and `start_solving` next."""
        times = (
            self.registry.next_expiry(),
            self._publish_at,
            self._debounce.next_time(),
            self._drawing_since,
            self._publisher.warm_until,
            self._publisher.resend_at,
            self._publisher.inform_at,
            self.restlessness.next_time(),
            self._publishing_since if self._publications else None,
            self._untold_since if self._untold else None,
            self._unjudged_since if self._unjudged else None,
            self._returning.until,
        )
        return min((time for time in times if time is not None), default=None)

    def handle_timer(self, now: float, unread: Collection[NodeName] = ()) -> None:
        """Let leases end, and publish what changed.

        `unread` are those of `registry.due` from whom the driver holds something that it has not passed on yet.
        """
        for sidecar in self.registry.expire(now, unread):
            self._close(sidecar.stream, CloseReason.LEASE_EXPIRED, now)
            self._forget(sidecar, RemovalReason.LEASE_EXPIRED, now)
            self._members_changed(now, sidecar.role)
        for gone in self._returning.missing(now, self._could_say):
            self.departed.note(gone)
            self._events.append(DepartureNotice(gone.name, gone))
        for name, stream, waited in self.restlessness.due(now, self._told_bytes):
            if self._streams.get(stream) == name and self.registry.get(name) is not None:
                for told in waited:
                    self._announced(name, told, now)
        if self._publisher.warm_until is not None and self._publisher.warm_until <= now:
            self._publisher.end_warm_up()
            self._members_changed(now)
        if self._publisher.resend_at is not None and self._publisher.resend_at <= now:
            self._publisher.send_refused_again()
            self._publish_soon(now)
        if self._publisher.inform_at is not None and self._publisher.inform_at <= now:
            self._publisher.inform()
            self._publish_soon(now)
        if self._publish_at is not None and self._publish_at <= now and not self._publications:
            self._publish(now)
        elif self._publications:
            self._go_on_publishing(now)
        self._tell_revocations()
        self._judge(now)

    def note_refused(self, name: NodeName, why: Why, text: str) -> None:
        """Note that the connection of a member was refused for its certificate, which is no sign that it is gone."""
        self._returning.is_refused(name, why, text)

    def remember(self, departures: Iterable[Departure], present: Iterable[Departure], now: float) -> None:
        """Remember what an earlier run knew: who was gone, and who was there; of these, those not back in time are
        gone."""
        for gone in departures:
            self.departed.note(gone)
        self._returning.expect(present, now + self._settings.warm_up_s + self._settings.lease_s)

    def _departure(self, sidecar: Sidecar, why: Why, text: str, now: float) -> Departure:
        return departure(sidecar, why, text, at=now, seen_at=self.registry.heard_at(sidecar.name, now))

    def _forget(self, sidecar: Sidecar, reason: RemovalReason, now: float) -> None:
        name = sidecar.name
        if reason is RemovalReason.REVOKED:
            self.reached.forget(name)
        gone = self._departure(sidecar, why_removed(sidecar, reason), "", now)
        last = None
        if sidecar.role is Role.ROBOT:
            paths = self.estimator.path_states(name)
            last = last_known(sidecar, self._publisher[name], paths, self._picture, self.plan)
        self.departed.note(gone, last)
        self._events.append(DepartureNotice(name, gone))
        self._forget_paths(name)
        self.unanswered.begin(name, sidecar.offered)
        self._refused_offers.forget(name)
        self.restlessness.forget(name)
        self._publisher.forget(name, sidecar.role)
        del self._told_intervals[name]

    def _begin_serving(self, name: NodeName) -> None:
        sidecar = self.registry.get(name)
        if sidecar is not None:
            self.unanswered.begin(name, sidecar.offered)

    def _forget_paths(self, name: NodeName) -> None:
        self.unanswered.forget(name)
        self.faults.forget(name)
        self.estimator.forget_paths(name)
        self._drawing.robot_changed(name)

    def _members_changed(self, now: float, role: Role = Role.CLOUD) -> None:
        """Note that members of this role changed, or something equivalent."""
        self._drawing.members_changed()
        self._debounce.note(Change.ROBOTS if role is Role.ROBOT else Change.MEMBERS, now)
        self._publish_soon(now)

    def _came_or_went(self, name: NodeName, role: Role, now: float) -> None:
        """Note that a member came or left by its own will: beyond its share told later, and not solved for at once."""
        if self.restlessness.take(name, now):
            self._members_changed(now, role)
            return
        self._drawing.members_changed()
        self._debounce.note(Change.REPORT, now)
        if self._publish_at is None:
            self._publish_at = now + RESTLESS_DELAY_S

    def _publish_soon(self, now: float) -> None:
        delay_s = PUBLISH_DELAY_S + PUBLISH_DELAY_EACH_S * len(self.registry)
        self._publish_at = min(self._publish_at or math.inf, now + delay_s)

    # ── solving ──

    def start_solving(self, now: float) -> Picture | None:
        """Return the problem to solve now, if it is due and drawn; `solved` has to follow.

        Drawing takes several calls in a large fleet: until it is done `next_timer` stays in the past.
        """
        if self._drawing_since is None:
            change = self._debounce.start(now)
            if change is None:
                return None
            self._drawing_since = now
            self.solves_routinely = change is Change.REPORT
            self._drawing.begin(routine=self.solves_routinely)
        # A robot that waits for its servers has a mapping; one made from no knowledge must not take its place.
        waits = self._publisher.waits
        ready = (sidecar for sidecar in self.registry if sidecar.ready and not waits(sidecar.name))
        if not self._drawing.advance(ready, self.permits, self.estimator, now, self._lost_share):
            return None
        self._drawing_since = None
        if self._drawing.urgent_left:
            self._debounce.go_on(now)
        if self._drawing.routine_left:
            self._debounce.note(Change.REPORT, now)
        return self._drawing.picture()

    def _lost_share(self, robot: NodeName) -> float:
        """Return the share of a robot's assignments whose paths are not up."""
        sidecar = self.registry.get(robot)
        if sidecar is None:
            return 0.0
        plans = (self.plan.blocks.get(BlockKey(robot, use.name)) for use in sidecar.uses)
        pairs = [pair for plan in plans if plan is not None for pair in plan.assignments]
        lost = sum(not self.estimator.path_up(robot, interface, server) for interface, server in pairs)
        return lost / len(pairs) if pairs else 0.0

    def settle(self, picture: Picture, plan: Plan, now: float) -> Settled:
        """Decide which parts of the solver's answer are worth a change, for `solved`.

        This changes nothing that other calls look at, so it may run on another thread between `start_solving` and
        `solved`: for a large fleet it takes as long as some hundred reports.
        """
        settled = self._stability.settle(picture.problem, plan, self.plan, now)
        settled = replace(settled, explore=self._exploration.update(picture.problem, settled))
        return Settled(picture, settled, changed_robots(self.plan, settled, self._picture, picture), plan.unproven)

    def solved(self, settled: Settled, now: float) -> None:
        """Take the settled answer to the problem of `start_solving`, and publish what is new."""
        self._debounce.finished(now)
        plan = settled.plan
        self.counters.solved += 1
        self.counters.unproven += settled.unproven
        if plan.relaxed and plan.relaxed != self.plan.relaxed:
            self.counters.relaxations += 1
        self.plan = plan
        self._picture = settled.picture
        if self._publish_at is None:
            self._begin_publishing(
                self._publisher.publish_plan(settled.robots, self.permits, plan, settled.picture, now), now
            )
        else:
            self._publisher.plan_changed(settled.robots)
            self._publish(now)

    def solving_failed(self, now: float) -> None:
        """Note that the solver raised: the plan in force stays, and the next routine solving tries again."""
        self._debounce.finished(now)
        self._debounce.note(Change.REPORT, now)

    def _publish(self, now: float) -> None:
        self._publish_at = None
        if self._publisher.release():
            self._drawing.members_changed()
            self._debounce.note(Change.MEMBERS, now)
        self._begin_publishing(self._publisher.publish(self.permits, self.plan, self._picture, now), now)

    def _begin_publishing(self, publication: Iterator[SendMessage | None], now: float) -> None:
        self._publications.append(publication)
        if len(self._publications) == 1:
            self._publishing_since = now
            self._go_on_publishing(now)

    def _go_on_publishing(self, now: float) -> None:
        """Examine some sidecars for news; `next_timer` is past until all are done."""
        looked_at = 0
        for send in self._publications[0]:
            if send is None:
                looked_at += 1
                if looked_at > PUBLISHED_AT_ONCE:
                    return
            else:
                self._sent(send, now)
        self._publications.popleft()

    def _sent(self, send: SendMessage, now: float) -> None:
        if send.stream in self._streams:
            if isinstance(send.message, MappingSet):
                self.history.note(self._streams[send.stream], send.message, now)
            self._events.append(send)

    def next_event(self) -> Event | None:
        """Return what the driver has to do next."""
        return self._events.popleft() if self._events else None

    # ── what the operator sees ──

    @property
    def shares_forgotten(self) -> int:
        """Members whose share of something was reset for lack of room."""
        return self.registry.shares_forgotten + self.restlessness.shares.forgotten + self.urgency.shares.forgotten

    def status(
        self, now: float, names: Iterable[NodeName] | None = None, *, abridged: bool = False
    ) -> list[SidecarStatus]:
        """Return every registered sidecar by name, or those of these names; `abridged`: shorter if all is in order."""
        if names is None:
            names = sorted(sidecar.name for sidecar in self.registry)
        return list(
            statuses(
                names,
                self.registry,
                self._publisher,
                self.estimator,
                self.permits,
                self.unanswered,
                self.faults,
                now,
                abridged=abridged,
            )
        )

    def explain(self, robot: NodeName, service: ServiceName, now: float) -> Explanation:
        """Return all that `explain_in_parts` explains."""
        return whole(self.explain_in_parts(robot, service, lambda: now))

    def explain_in_parts(
        self, robot: NodeName, service: ServiceName, clock: Callable[[], float]
    ) -> tuple[Explanation, Pairs]:
        """Explain why requests go, or went, where they do. Raise UnknownNameError if robot or service is unknown.

        Return the explanation without its pairs, and these, made as they are read at the times that `clock` returns.
        """
        now = clock()
        gone = self.departed.get(robot)
        if gone is not None and gone.role is Role.ROBOT and self.registry.get(robot) is None:
            last = self.departed.last_known(robot)
            return explain_departed(gone, last, service, estimator=self.estimator, history=self.history, now=now)
        sidecar, use = find(self.registry, self.permits, robot, service)
        mapping = self._publisher[robot].mapping
        return explain(
            sidecar,
            use,
            picture=self._picture,
            plan=self.plan,
            estimator=self.estimator,
            sent=mapping.sent or (),
            sync=mapping.status,
            history=self.history.of(BlockKey(robot, service)),
            clock=clock,
        )

    def sync_states(self) -> Iterator[tuple[NodeName, ResourceKind, SyncState]]:
        """Yield how far every registered sidecar follows; clouds get no mapping."""
        return self._publisher.sync_states()

    def view(self, name: NodeName, now: float) -> MemberView | None:
        """Return what the metrics say about a member; None if it is no longer present."""
        sidecar = self.registry.get(name)
        if sidecar is None:
            return None
        return view_of(
            sidecar,
            self._publisher[name],
            self.plan,
            self._picture,
            self.estimator,
            self.reached,
            self.unanswered,
            self.faults,
            is_there=lambda server: is_met(name, server, self.registry, self.permits),
            is_offered=lambda service: is_offered(name, service, self.registry, self.permits),
            may_offer=lambda service: self.permits.may_offer(name, service),
            seen_at=self.registry.heard_at(name, now),
            now=now,
        )
