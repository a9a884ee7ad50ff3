"""Implements the sidecar's end of the control stream: what to say, what to believe, when to try again. Sans-IO.

    OFFLINE ──(retry_at: open a stream)──▶ REGISTERING ──(Welcome)──▶ ONLINE
       ▲                                       │                        │
       └───────(stream ended, no Welcome)──────┴────────────────────────┘

The rules are those of xDS. A resource comes with a version and a nonce; the answer repeats the nonce with the version
that is then in force. Only the newest answer for each resource matters, since the control plane ignores stale nonces:
so what waits to be sent is bounded without any queue. Versions are ordered only within one stream: the next control
plane may begin with any version. A mapping comes whole. Peers come whole or as changes, in one message or several; what
is put in force is whole (`PeerAssembly`).
"""

from __future__ import annotations

import enum
import math
from collections import Counter
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from plr.protos.model.ids import Version
from plr.protos.model.mapping import MappingSet
from plr.protos.model.members import NO_REVOCATIONS, CandidateSet, PeerSet, RevocationSet, ServiceSet
from plr.protos.model.report import Report
from plr.protos.model.stream import Ack, Drain, Heartbeat, Nack, ResourceKind, Welcome
from plr.sidecar.core.base.report_scope import ReportScope
from plr.sidecar.core.control.backoff import Backoff
from plr.sidecar.core.control.peer_assembly import PeerAssembly

if TYPE_CHECKING:
    import random

    from plr.protos.model.members import Registration
    from plr.protos.model.stream import ControlMessage, SidecarMessage

RETRY_FIRST_S = 0.2
"""First bound of the delay before a new stream: a restarted control plane is back within about a second."""

RETRY_MAX_S = 10.0
"""Largest bound: a compromise between the load of a waiting fleet and the time to notice that the control plane is
back."""

RETRY_LEAST_S = 1.0
"""Least time between two attempts when a change of the network is the reason for the second."""

WELCOME_TIMEOUT_S = 5.0
"""A stream without Welcome for this long is given up: connection set-up over a bad cellular link takes 1 to 2 s."""

WELCOME_TIMEOUT_MAX_S = 35.0
"""Each stream given up doubles the next wait, up to this: a fleet that starts all at once takes longer than the first
timeout, and a sidecar that gives up and starts again has wasted its turn."""

PATIENCE_TIMES = 3.0
"""A sidecar waits in addition this many times as long as the attempts of its fleet may be apart. From 1,500 sidecars on
the attempts are too close together to let all in."""

STABLE_AFTER_S = 5.0
"""A stream this old ended for a new reason: the backoff starts again."""

HEARTBEATS_PER_LEASE = 3.0
"""Heartbeats per lease: two may get lost before it ends."""

URGENT_PART, URGENT_LEAST_S = 0.1, 0.1
"""Least time between two urgent reports: this share of the interval, and at least this many seconds."""

PERHAPS_UNTOLD_S = 15.0
"""Urgent news no older than this at the start of a stream is reported again: the stream before may have been dead
already, unnoticed."""

MIN_INTERVAL_S = 0.05
"""Shortest interval that the control plane may ask for: it must not be able to make the sidecar spin."""

_NOTHING_MEASURED = Report()


class ControlState(enum.Enum):
    """State of the control stream."""

    OFFLINE = "offline"
    REGISTERING = "registering"
    ONLINE = "online"


@dataclass(slots=True)
class ControlStats:
    """Counters of the control stream."""

    attempts: int = 0
    streams: int = 0
    """Streams that got their Welcome."""
    reports: int = 0
    reports_dropped: int = 0
    """Reports collected but not sent before the stream ended; one already handed to it may get lost uncounted."""
    heartbeats: int = 0
    acks: Counter[ResourceKind] = field(default_factory=Counter)
    nacks: Counter[ResourceKind] = field(default_factory=Counter)
    ignored: Counter[str] = field(default_factory=Counter)
    """Messages of the control plane that were not acted on, by reason."""
    connections: Counter[str] = field(default_factory=Counter)
    """TCP connections that streams used, by interface."""
    connections_left: Counter[str] = field(default_factory=Counter)
    """Connections that were left for another way, by cause."""
    dial_drops: Counter[str] = field(default_factory=Counter)
    """Addresses left out and connections turned away by the dialer, by reason."""


@dataclass(frozen=True, slots=True)
class Apply:
    """A resource for the driver to put in force, after which it calls `ControlSession.applied`."""

    resource: ResourceKind
    content: PeerSet | MappingSet


ControlEvent = Welcome | Apply
"""Task that a received message sets the driver."""


class ControlSession:
    """One sidecar's dialogue with the control plane, over however many streams.

    `registration` names the versions already in force, such as those loaded from disk; `peers` is the set of that
    version.
    """

    def __init__(self, registration: Registration, rng: random.Random, peers: PeerSet | None = None) -> None:
        self._registration = replace(registration, incremental=True)
        self._assembly = PeerAssembly(peers)
        self._in_force = {
            ResourceKind.PEERS: registration.peers_version,
            ResourceKind.MAPPING: registration.mapping_version,
        }
        self._taken: dict[ResourceKind, Version] = {}
        """The newest version that was acknowledged on this stream."""
        self._backoff = Backoff(rng, first_s=RETRY_FIRST_S, max_s=RETRY_MAX_S)
        self._registered_with = b""
        """The credential in this stream's registration."""
        self._candidates = CandidateSet()
        self._services = ServiceSet()
        self._revocations = NO_REVOCATIONS
        self._draining = False
        self.refused: Apply | None = None
        """The newest mapping, if it could not be put in force: it may fit when interfaces or peers have changed."""
        self.state = ControlState.OFFLINE
        self.stats = ControlStats()
        self._retry_at = 0.0
        self._patience_s = WELCOME_TIMEOUT_S
        """Time (s) that a stream may be without Welcome ..."""
        self._first_patience_s = WELCOME_TIMEOUT_S
        """... and that of the first stream after the last Welcome or change of the network."""
        self._opened_at = 0.0
        self._refused = False
        self._heartbeat_interval_s = 0.0
        self._report_interval_s = 0.0
        self._reported_at = 0.0
        self._urgent_at = -math.inf
        self._urgent = False
        """Whether the next whole report is urgent."""
        self._urgent_told_at = -math.inf
        self._changes_at = math.inf
        """When to report changes alone."""
        self._told_whole = False
        """Whether this stream has had a whole report: changes tell little to a control plane that knows nothing."""
        self._heartbeat_at = 0.0
        self._report_at = 0.0
        self._clear_outgoing()

    def _clear_outgoing(self) -> None:
        self._register_due = False
        self._candidates_due = False
        self._services_due = False
        self._revocations_due = False
        self._drain_due = False
        self._heartbeat_due = False
        self._answers: dict[ResourceKind, Ack | Nack] = {}
        self._report: Report | None = None

    @property
    def retry_at(self) -> float:
        """Return when to open the next stream; meaningful only while offline."""
        return self._retry_at

    def version(self, resource: ResourceKind) -> Version:
        """Return the version in force; 0 means none."""
        return self._in_force[resource]

    def set_credential(self, credential: bytes) -> None:
        """Use the session's renewed credential in the next registration.

        The driver ends the present stream for it. That stream gets no more addresses: they are now signed with the new
        certificate, and the control plane would relay them with the old credential, as a forger does.
        """
        self._registration = replace(self._registration, credential=credential)

    def not_restored(self, held: Apply) -> None:
        """Ask again for a resource that the registration claims but that could not be put in force."""
        self._in_force[held.resource] = Version(0)
        if held.resource is ResourceKind.PEERS:
            self._assembly = PeerAssembly(None)
        self._keep_if_refused(held, refused=True)

    # ── the stream ──

    def opened(self, now: float) -> None:
        """Begin a stream: everything is said again on it."""
        self._clear_outgoing()
        self._taken.clear()
        self._changes_at, self._told_whole = math.inf, False
        self._assembly.begin_stream()
        self.state = ControlState.REGISTERING
        self.stats.attempts += 1
        self._opened_at = now
        self._register_due = True
        self._candidates_due = True
        self._services_due = True
        self._revocations_due = self._revocations != NO_REVOCATIONS
        self._drain_due = self._draining

    def closed(self, now: float, *, refused: bool = False, moved: bool = False) -> float:
        """Note that the stream ended, or could not be opened; return the seconds until the next attempt.

        `refused`: the control plane decided it, and will hardly change its mind within a second. `moved`: we decided
        it, since there is a better way, which is taken at once.
        """
        if self.state is ControlState.ONLINE and now - self._opened_at >= STABLE_AFTER_S:
            self._backoff.reset()
        if self._report is not None:
            self.stats.reports_dropped += 1
        if self.welcome_overdue(now):
            self._patience_s = min(2.0 * self._patience_s, WELCOME_TIMEOUT_MAX_S)
        self._clear_outgoing()
        self.state = ControlState.OFFLINE
        self._refused = refused
        delay_s = 0.0 if moved else self._backoff.next_delay_s(refused=refused)
        self._retry_at = now + delay_s
        return delay_s

    def network_changed(self, now: float) -> None:
        """Try again soon, though not in step with others, as an attempt may succeed that could not before.

        Do not if the control plane refuses us, nor more often than once in RETRY_LEAST_S however often networks change.
        """
        if self.state is ControlState.OFFLINE and not self._refused:
            self._backoff.reset()
            self._patience_s = self._first_patience_s
            soon = max(now, self._opened_at + RETRY_LEAST_S) + self._backoff.next_delay_s()
            self._retry_at = min(self._retry_at, soon)

    # ── from the control plane ──

    def receive(self, message: ControlMessage, now: float) -> ControlEvent | None:
        """Take a message of the current stream; return what the driver has to do about it."""
        match message:
            case Welcome():
                return self._receive_welcome(message, now)
            case PeerSet():
                return self._receive_peers(message)
            case MappingSet():
                return Apply(ResourceKind.MAPPING, message) if self._is_news(ResourceKind.MAPPING, message) else None

    def _receive_welcome(self, welcome: Welcome, now: float) -> Welcome:
        told_before = self.state is ControlState.ONLINE
        if not told_before:
            self.stats.streams += 1
        self.state = ControlState.ONLINE
        if welcome.reconnect_max_s:
            reconnect_max_s = min(max(welcome.reconnect_max_s, RETRY_FIRST_S), RETRY_MAX_S)
            self._backoff.set_max(reconnect_max_s)
            self._first_patience_s = WELCOME_TIMEOUT_S + PATIENCE_TIMES * reconnect_max_s
        self._patience_s = self._first_patience_s
        self._heartbeat_interval_s = max(welcome.lease_s / HEARTBEATS_PER_LEASE, MIN_INTERVAL_S)
        self._report_interval_s = max(welcome.report_interval_s, MIN_INTERVAL_S)
        self._heartbeat_at = now + self._heartbeat_interval_s
        self._report_at = (
            min(self._report_at, now + self._report_interval_s) if told_before else (now + self._report_interval_s)
        )
        if not told_before and (self._urgent_at > self._reported_at or now - self._urgent_at < PERHAPS_UNTOLD_S):
            self._report_at = min(self._report_at, max(now, self._soonest_report()))
        return welcome

    def _receive_peers(self, message: PeerSet) -> Apply | None:
        said = self._assembly.take(message)
        if said is None:
            return None
        if not self._is_news(ResourceKind.PEERS, said):
            return None
        whole = self._assembly.whole(said)
        if isinstance(whole, str):
            self.stats.ignored["peers_malformed" if self._assembly.is_upon(said) else "peers_without_base"] += 1
            self._nack(ResourceKind.PEERS, said.nonce, whole)
            return None
        return Apply(ResourceKind.PEERS, whole)

    def _is_news(self, resource: ResourceKind, content: PeerSet | MappingSet) -> bool:
        """Return whether to put this in force; answer it if not."""
        if content.version == self._in_force[resource]:
            self.stats.ignored[f"{resource.value}_repeated"] += 1
            self._ack(resource, content.nonce)
            return False
        least = max(self._taken.get(resource, Version(0)), Version(1))
        if content.version < least:
            self.stats.ignored[f"{resource.value}_older"] += 1
            self._nack(
                resource,
                content.nonce,
                f"version {content.version} is older than {least}, which this stream has already had",
            )
            return False
        return True

    def applied(self, apply: Apply, error: str | None) -> None:
        """Answer a resource that the driver put in force, or could not because of `error`."""
        self._keep_if_refused(apply, refused=error is not None)
        if error is not None:
            self._nack(apply.resource, apply.content.nonce, error)
            return
        self._in_force[apply.resource] = apply.content.version
        if isinstance(apply.content, PeerSet):
            self._assembly.in_force(apply.content)
            # A control plane that has just started believes reports about a server only once that is back, too.
            self._report_at = min(self._report_at, self._soonest_report())
        self._ack(apply.resource, apply.content.nonce)

    def _keep_if_refused(self, apply: Apply, *, refused: bool) -> None:
        if apply.resource is ResourceKind.MAPPING:
            self.refused = apply if refused else None

    def applied_late(self) -> None:
        """Note that the driver put in force what was `refused`.

        The control plane is not told: it considers a refused version refused, and sends again what it wants in force.
        So the version in force stays the same here, too, and whatever comes is newer.
        """
        self.refused = None

    def undecodable(self, resource: ResourceKind | None, nonce: int, error: str) -> None:
        """Refuse a malformed message; `resource` and `nonce` are what could be read of it."""
        self.stats.ignored["undecodable"] += 1
        if resource is ResourceKind.PEERS:
            self._assembly.leave_out(nonce)
        if resource is not None:
            self._nack(resource, nonce, error)

    def unknown(self) -> int:
        """Count a message that only a newer sidecar knows; return how many were left out."""
        self.stats.ignored["unknown_kind"] += 1
        return self.stats.ignored["unknown_kind"]

    def _ack(self, resource: ResourceKind, nonce: int) -> None:
        self.stats.acks[resource] += 1
        self._taken[resource] = self._in_force[resource]
        self._answers[resource] = Ack(resource, self._in_force[resource], nonce)

    def _nack(self, resource: ResourceKind, nonce: int, error: str) -> None:
        self.stats.nacks[resource] += 1
        self._answers[resource] = Nack(resource, self._in_force[resource], nonce, error)

    # ── from the sidecar ──

    def set_candidates(self, candidates: CandidateSet) -> None:
        """Replace the addresses that we announce."""
        if candidates != self._candidates:
            self._candidates = candidates
            self._candidates_due = self.state is not ControlState.OFFLINE

    def set_services(self, services: ServiceSet) -> None:
        """Replace the services that we announce."""
        if services != self._services:
            self._services = services
            self._services_due = self.state is not ControlState.OFFLINE

    def set_revocations(self, held: RevocationSet) -> None:
        """Replace the revocation lists that we announce as in use."""
        if held != self._revocations:
            self._revocations = held
            self._revocations_due = self.state is not ControlState.OFFLINE

    def drain(self) -> None:
        """Say goodbye, on this stream and on later ones."""
        if not self._draining:
            self._draining = True
            self._drain_due = self.state is not ControlState.OFFLINE

    def report_due(self, now: float) -> ReportScope | None:
        """Return what the driver has to collect and pass to `send_report` now."""
        if self.state is not ControlState.ONLINE or self._report is not None:
            return None
        if now >= self._report_at:
            return ReportScope.ALL
        return ReportScope.CHANGES if now >= self._changes_at else None

    def report_at_once(self, now: float, scope: ReportScope) -> None:
        """Report what cannot wait for the interval: a path changed, or a deadline was missed.

        The fleet's size still counts, as this may happen to all repeatedly: two such reports are at least a tenth of
        the interval apart.
        Without a stream the report waits for the next one.
        """
        self._urgent_at = now
        soonest = max(now, self._soonest_report())
        if scope is ReportScope.CHANGES and self._told_whole:
            self._changes_at = min(self._changes_at, soonest)
        else:
            self._urgent = True
            self._report_at = min(self._report_at, soonest)

    def _soonest_report(self) -> float:
        return self._urgent_told_at + max(self._report_interval_s * URGENT_PART, URGENT_LEAST_S)

    def send_report(self, report: Report, now: float) -> None:
        """Send what was measured since the last report; an empty report is left out."""
        self._reported_at, self._changes_at = now, math.inf
        if report.changes_only:
            self._urgent_told_at = now
        else:
            if self._urgent:
                self._urgent, self._urgent_told_at = False, now
            self._report_at = now + self._report_interval_s
            self._told_whole = True
        if replace(report, changes_only=False) != _NOTHING_MEASURED and self.state is ControlState.ONLINE:
            self._report = report

    # ── time ──

    def next_timer(self) -> float:
        """Return when `handle_timer` (offline: a new stream) is due."""
        match self.state:
            case ControlState.OFFLINE:
                return self._retry_at
            case ControlState.REGISTERING:
                return self._opened_at + self._patience_s
            case ControlState.ONLINE:
                return min(self._heartbeat_at, self._report_at, self._changes_at)

    def handle_timer(self, now: float) -> None:
        """Do what is due."""
        if self.state is ControlState.ONLINE and now >= self._heartbeat_at:
            self._heartbeat_due = True

    def welcome_overdue(self, now: float) -> bool:
        """Return whether to give the stream up for lack of a Welcome."""
        return self.state is ControlState.REGISTERING and now >= self._opened_at + self._patience_s

    # ── to the control plane ──

    def messages_to_send(self, now: float) -> list[SidecarMessage]:
        """Return the messages to send on the current stream, in order."""
        messages: list[SidecarMessage] = []
        if self._register_due:
            messages.append(self._current_registration())
            self._registered_with = self._registration.credential
            self._register_due = False
        if self.state is ControlState.REGISTERING and not self._draining:
            # The rest waits for the Welcome: a write that meets a refusal can hide its reason (gRPC says INTERNAL).
            return messages
        if self._candidates_due and self._registered_with == self._registration.credential:
            messages.append(self._candidates)
        if self._services_due:
            messages.append(self._services)
        if self._revocations_due:
            messages.append(self._revocations)
        messages += self._answers.values()
        if self._report is not None:
            messages.append(self._report)
            self.stats.reports += 1
        if self._drain_due:
            messages.append(Drain())
        if self._heartbeat_due and not messages:
            messages.append(Heartbeat())
            self.stats.heartbeats += 1
        if messages:
            self._heartbeat_at = now + self._heartbeat_interval_s
        self._clear_outgoing()
        return messages

    def _current_registration(self) -> Registration:
        return replace(
            self._registration,
            peers_version=self._in_force[ResourceKind.PEERS],
            mapping_version=self._in_force[ResourceKind.MAPPING],
        )
