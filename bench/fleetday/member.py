"""Simulates one sidecar: its true state, its end of the control stream, and what it holds."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from bench.fleetday.held import Held
from bench.fleetday.line import Line
from plr.protos.base.histogram import Histogram
from plr.protos.model.ids import PROTOCOL_VERSION, InterfaceId, InterfaceName, Role, SessionId, Version
from plr.protos.model.members import Candidate, CandidateKind, CandidateSet, PeerSet, Registration, ServiceSet
from plr.protos.model.report import LatencyReport, OutcomeReport, PathReport, Report
from plr.protos.model.stream import ResourceKind, Welcome
from plr.sidecar.core.base.report_scope import ReportScope
from plr.sidecar.core.control.session import Apply, ControlSession, ControlState

if TYPE_CHECKING:
    import random

    from bench.fleetday.plane import Plane
    from bench.fleetday.timeline import Timeline
    from plr.protos.model.ids import Address, InterfaceName, NodeName
    from plr.protos.model.mapping import MappingSet
    from plr.protos.model.stream import ControlMessage

NOTICES_S = (10.0, 40.0)
"""Range of the time in which keepalives find a connection that died silently."""

NOTHING = Report()
_EMPTY = Histogram()


def _histograms(rng: random.Random, count: int, middle_s: float) -> list[Histogram]:
    made = []
    for _ in range(count):
        histogram = Histogram()
        for _ in range(5):
            histogram.record(rng.lognormvariate(0.0, 0.4) * middle_s)
        made.append(histogram)
    return made


class Measurements:
    """Possible measurements of robots, drawn once for all of them."""

    def __init__(self, rng: random.Random) -> None:
        self.round_trips = _histograms(rng, 64, 0.04)
        self.network = _histograms(rng, 64, 0.05)
        self.processing = _histograms(rng, 16, 0.02)


class Member:
    """A robot or a cloud from its first start on; it stays the same across restarts."""

    def __init__(
        self,
        name: NodeName,
        role: Role,
        number: int,
        region: str,
        *,
        timeline: Timeline,
        plane: Plane,
        rng: random.Random,
        measurements: Measurements,
        measures_every_s: float,
    ) -> None:
        self.name = name
        self.role = role
        self.number = number
        self._region = region
        self._timeline = timeline
        self._plane = plane
        self._rng = rng
        self._measurements = measurements
        self._measures_every_s = measures_every_s
        self.token = number.to_bytes(16, "big")
        self.incarnation = 0
        self.session_id = SessionId(0)
        self.credential = b""
        self.interfaces: dict[InterfaceName, tuple[Address, ...]] = {}
        """Present interfaces, with the addresses at which each is reached."""
        self._ids: dict[InterfaceName, InterfaceId] = {}
        self.candidates = CandidateSet()
        self.services = ServiceSet()
        self.alive = False
        self.draining = False
        self.held = Held()
        self.session: ControlSession | None = None
        self.line: Line | None = None
        self.network_down = False
        """Whether new streams cannot get through."""
        self.refuses = False
        """Whether it refuses everything that it is sent."""
        self.slow = False
        self.changed_at = timeline.now
        """When anything that others must know of it last changed."""
        self.ill_at = timeline.now
        """When it last had a reason not to hold what it should."""
        self.dark: set[InterfaceName | tuple[InterfaceName, NodeName]] = set()
        """Interfaces and pairs over which nothing arrives."""
        self.lost_at: dict[InterfaceName, float] = {}
        """Interfaces that went away, and when."""
        self._paths_due = False
        self._told_up: dict[tuple[InterfaceName, NodeName], bool] = {}
        """Whether each path was up when last reported."""
        self._measure_at = 0.0
        self._wake_at = float("inf")
        self.complaints: list[str] = []
        """Observations that no sidecar should ever make."""
        self.applied = 0
        self.refused = 0

    # ── life ──

    def start(self, *, keeps_disk: bool) -> None:
        """Start the process: a new session, which holds what is on the disk."""
        if not keeps_disk:
            self.held = Held()
        self.incarnation += 1
        self.session_id = SessionId(self.number << 20 | self.incarnation)
        self.credential = b"%s/%d" % (self.name.encode(), self.incarnation)
        self.alive, self.draining, self.refuses, self.slow = True, False, False, False
        self.session = ControlSession(self.registration(), self._rng)
        self.session.set_candidates(self.candidates)
        self.session.set_services(self.services)
        self._changed()
        self.fell_ill()
        self._schedule()

    def registration(self) -> Registration:
        """Return its registration."""
        return Registration(
            PROTOCOL_VERSION,
            self.name,
            self.role,
            self.session_id,
            self.token,
            self.incarnation,
            "day",
            self.held.peers.version,
            self.held.mapping_version,
            self.credential,
            self._region,
        )

    def crash(self, *, silently: bool) -> None:
        """End the process; `silently` with its host, so that nobody learns of it before the lease ends."""
        self.alive = False
        self._wake_at = float("inf")
        line, self.line = self.line, None
        if line is not None:
            line.dead |= silently
            line.hang_up()
        self._changed()
        self.fell_ill()

    def drain(self) -> None:
        """Say goodbye; `crash` follows once requests in flight are done."""
        assert self.session is not None
        self.draining = True
        self.session.drain()
        self._changed()
        self._say()

    def renew_credential(self) -> None:
        """Take a new certificate: the stream is reopened with it."""
        self.credential += b"+"
        if self.session is not None and self.alive:
            self.session.set_credential(self.credential)
        self._changed()
        self.reconnect()

    def reconnect(self) -> None:
        """Replace the stream by a better one."""
        line, self.line = self.line, None
        if line is not None and self.session is not None:
            line.hang_up()
            self.fell_ill()
            self.session.closed(self._timeline.now, moved=True)
            self._schedule()

    def _changed(self) -> None:
        self.changed_at = self._timeline.now

    def fell_ill(self) -> None:
        """Note that something keeps it from holding what it should."""
        self.ill_at = self._timeline.now

    # ── its state ──

    def set_interfaces(self, interfaces: dict[InterfaceName, tuple[Address, ...]]) -> None:
        """Add or remove interfaces, or change their addresses."""
        now = self._timeline.now
        for gone in self.interfaces.keys() - interfaces.keys():
            self.lost_at[gone] = now
        for back in interfaces.keys() - self.interfaces.keys():
            self.lost_at.pop(back, None)
            self._ids.setdefault(back, InterfaceId(len(self._ids)))
        self.interfaces = interfaces
        kinds = (CandidateKind.HOST, CandidateKind.SERVER_REFLEXIVE)
        candidates = tuple(
            Candidate(self._ids[interface], interface, kind, address)
            for interface, addresses in interfaces.items()
            for kind, address in zip(kinds, addresses, strict=True)
        )
        self.candidates = CandidateSet(candidates, (), self.candidates.serial + 1)
        self._changed()
        if self.alive and self.session is not None:
            self.session.set_candidates(self.candidates)
            self.paths_changed()
            refused = self.session.refused
            if refused is not None and self._put_in_force(refused.content) is None:
                self.session.applied_late()
            self._say()

    def set_services(self, services: ServiceSet) -> None:
        """Change the services that it offers or carries."""
        self.services = services
        self._changed()
        if self.alive and self.session is not None:
            self.session.set_services(services)
            self._say()

    def paths_changed(self) -> None:
        """Report at once that a path went up or down."""
        if self.role is Role.ROBOT and self.session is not None:
            self._paths_due = True
            self.session.report_at_once(self._timeline.now, ReportScope.CHANGES)
            self._schedule()

    # ── its stream ──

    @property
    def online(self) -> bool:
        """Whether it believes that it has a stream accepted by the control plane."""
        return self.alive and self.session is not None and self.session.state is ControlState.ONLINE

    def _schedule(self) -> None:
        assert self.session is not None
        when = self.session.next_timer()
        if self.alive and when < self._wake_at:
            self._wake_at = when
            self._timeline.at(when, self._wake)

    def _wake(self) -> None:
        now = self._timeline.now
        session = self.session
        if not self.alive or now < self._wake_at or session is None:
            return
        self._wake_at = float("inf")
        if session.state is ControlState.OFFLINE:
            if now >= session.retry_at:
                self._open(session)
        elif session.welcome_overdue(now):
            self._give_up()
        else:
            session.handle_timer(now)
            scope = session.report_due(now)
            if scope is not None:
                changes_only = scope is ReportScope.CHANGES
                session.send_report(self._path_changes() if changes_only else self._measure(now), now)
            self._say()
        self._schedule()

    def _open(self, session: ControlSession) -> None:
        session.opened(self._timeline.now)
        self.line = Line(self._timeline, self._plane, self, self._rng)
        self.fell_ill()
        if self.network_down:
            self.line.dead = True
        elif not self._plane.up:
            line = self.line
            self._timeline.after(0.05, lambda: self.line_ended(line, refused=False))
            return
        if self.slow:
            self.line.slow_s = self._rng.uniform(0.5, 5.0)
        self._say()

    def _give_up(self) -> None:
        line, self.line = self.line, None
        if line is not None:
            line.hang_up()
        assert self.session is not None
        self.session.closed(self._timeline.now)

    def _say(self) -> None:
        if self.line is None or self.session is None:
            return
        for message in self.session.messages_to_send(self._timeline.now):
            self.line.say(message)
        self._schedule()

    def line_ended(self, line: Line, *, refused: bool) -> None:
        """Handle the end of the stream as seen from this side."""
        if line is not self.line or self.session is None:
            return
        self.line = None
        self.fell_ill()
        self.session.closed(self._timeline.now, refused=refused)
        self._wake_at = float("inf")
        self._schedule()

    def break_line(self, *, half_open: bool) -> None:
        """Break the connection; `half_open` means silently, so that each end finds out in its own time."""
        line = self.line
        if line is None:
            return
        self.fell_ill()
        if half_open:
            line.dead = True
            notices_s = self._rng.uniform(*NOTICES_S)
            self._timeline.after(notices_s, lambda: self.line_ended(line, refused=False))
        else:
            line.cut()

    def stall(self, seconds: float) -> None:
        """Read nothing for a while."""
        if self.line is not None:
            self.line.stalled_until = self._timeline.now + seconds

    def hear(self, line: Line, message: ControlMessage) -> None:
        """Handle a message of the control plane."""
        if line is not self.line or self.session is None:
            return
        before = self.session.state
        event = self.session.receive(message, self._timeline.now)
        if isinstance(event, Welcome):
            if before is not ControlState.ONLINE:
                self.fell_ill()
                self.paths_changed()
            # It may wake sooner than planned for the longer patience of a registration.
        elif isinstance(event, Apply):
            self._apply(event)
        elif not isinstance(message, Welcome) and message.version <= self.session.version(_resource_of(message)):
            # A newer message that is not taken changes a set that it refused: it says so, and gets the whole set.
            self.complaints.append(f"{self.name}: a version that is not newer: {message.version}")
        self._say()
        self._schedule()

    def _apply(self, apply: Apply) -> None:
        assert self.session is not None
        error = "cannot hold it now" if self.refuses else self._put_in_force(apply.content)
        self.session.applied(apply, error)
        if error is not None:
            self.refused += 1
            return
        self.applied += 1
        if isinstance(apply.content, PeerSet):
            self.paths_changed()
            refused = self.session.refused
            if refused is not None and not self.refuses and self._put_in_force(refused.content) is None:
                self.session.applied_late()

    def _put_in_force(self, content: PeerSet | MappingSet) -> str | None:
        if isinstance(content, PeerSet):
            if content.version <= self.held.peers.version:
                self.complaints.append(f"{self.name}: peers {content.version} after {self.held.peers.version}")
            self.held.peers.apply(content)
            return None
        for mapping in content.services:
            for assignment in (*mapping.assignments, *((mapping.explore,) if mapping.explore else ())):
                if assignment.interface not in self.interfaces:
                    return f"no interface {assignment.interface}"
                if assignment.server not in self.held.peers.table:
                    return f"no peer {assignment.server}"
        self.held.mapping = content.services
        self.held.mapping_version = Version(max(content.version, self.held.mapping_version))
        return None

    # ── its measurements ──

    def is_up(self, interface: InterfaceName, server: NodeName) -> bool:
        """Return whether datagrams arrive over this path."""
        return interface not in self.dark and (interface, server) not in self.dark

    def _path_changes(self) -> Report:
        """Return the paths whose state differs from the last report."""
        states = self._path_states()
        changed = [(pair, up) for pair, up in states.items() if self._told_up.get(pair) != up]
        self._told_up = states
        return Report(paths=tuple(PathReport(*pair, up, _EMPTY) for pair, up in changed), changes_only=True)

    def _path_states(self) -> dict[tuple[InterfaceName, NodeName], bool]:
        pairs = ((interface, server) for server in self.held.peers.table for interface in self.interfaces)
        return {pair: self.is_up(*pair) for pair in pairs}

    def _measure(self, now: float) -> Report:
        if self.role is Role.CLOUD:
            return NOTHING
        measures = now >= self._measure_at
        if not measures and not self._paths_due:
            return NOTHING
        self._paths_due = False
        self._told_up = self._path_states()
        rng, made = self._rng, self._measurements
        paths = tuple(
            PathReport(*pair, up, rng.choice(made.round_trips) if measures else _EMPTY)
            for pair, up in self._told_up.items()
        )
        if not measures:
            return Report(paths=paths)
        self._measure_at = now + rng.expovariate(1.0 / self._measures_every_s)
        latencies = tuple(
            LatencyReport(
                assignment.interface,
                assignment.server,
                mapping.service,
                0,
                rng.choice(made.network),
                _EMPTY,
                rng.choice(made.processing),
                requests=5,
                missed=int(rng.random() < 0.02),
            )
            for mapping in self.held.mapping
            for assignment in mapping.assignments
            if self.is_up(assignment.interface, assignment.server)
        )
        outcomes = tuple(OutcomeReport(mapping.service, ok=5) for mapping in self.held.mapping)
        return Report(latencies, paths, outcomes)

    def registration_as_told(self) -> Registration:
        """Return its registration without what it holds."""
        return dataclasses.replace(self.registration(), peers_version=Version(0), mapping_version=Version(0))


def _resource_of(message: PeerSet | MappingSet) -> ResourceKind:
    return ResourceKind.PEERS if isinstance(message, PeerSet) else ResourceKind.MAPPING
