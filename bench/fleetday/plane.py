"""Simulates the control plane: its core, matcher and event log, and the work of its loop. It can be killed."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import TYPE_CHECKING

from plr.controlplane.core.control.control import ControlCore
from plr.controlplane.core.control.events import (
    CutOffNotice,
    DepartureNotice,
    NackNotice,
    OffersRefusedNotice,
    StreamLostNotice,
    UnmetNotice,
)
from plr.controlplane.core.publish.messages import CloseReason, EndStream, SendMessage
from plr.controlplane.core.registry.registry import Refusal
from plr.controlplane.observe.event_log import EventLog
from plr.controlplane.observe.remembered import departures
from plr.controlplane.solver.matcher import Matcher
from plr.protos.model.fleet_events import EventKind

if TYPE_CHECKING:
    import random
    from pathlib import Path

    from bench.fleetday.line import Line
    from bench.fleetday.timeline import Timeline
    from plr.controlplane.core.control.events import Settings
    from plr.controlplane.core.formulation.block import Picture
    from plr.controlplane.core.policy.policy import Policy
    from plr.controlplane.core.problem.plan import Plan
    from plr.controlplane.core.registry.registry import StreamId
    from plr.protos.model.ids import NodeName
    from plr.protos.model.members import Registration, RemovalReason
    from plr.protos.model.stream import Heartbeat, SidecarMessage

TURN_S = 0.02
"""Minimum interval between turns of the loop that follow each other."""

SOLVER_LIMIT_S = 1.0
"""Solver's time limit in real time; a day's problems are solved in a part of it."""

FAILS_ONE_IN = 500
"""One in this many solvings raises."""

LOAD_EVERY_S = 10.0

WALL_S = 1_800_000_000.0
"""Seconds since 1970 at simulated time 0."""


class Plane:
    """Successive control planes at the same address and with the same disk."""

    def __init__(
        self, timeline: Timeline, settings: Settings, folder: Path, rng: random.Random, *, solving_s: float
    ) -> None:
        self._solving_s = solving_s
        self._timeline = timeline
        self._settings = settings
        self._folder = folder
        self._rng = rng
        self._core: ControlCore | None = None
        self._matcher = Matcher()
        self._lines: dict[StreamId, Line] = {}
        self._turn_at = float("inf")
        self._turned_at = 0.0
        self.events: EventLog | None = None
        self.policy: Policy | None = None
        self.crl = b""
        self.barred: set[NodeName] = set()
        """Members with revoked or expired certificates: the gate in front of gRPC refuses them."""
        self.busy = 0.2
        self.clock_error_s = 0.0
        """Error of its wall clock."""
        self.started_at = 0.0
        self.starts = 0
        self.solved = 0
        self.sent = 0
        self.received = 0

    @property
    def up(self) -> bool:
        """Whether a control plane runs."""
        return self._core is not None

    @property
    def core(self) -> ControlCore:
        """The core of the running control plane."""
        assert self._core is not None
        return self._core

    def _wall(self) -> float:
        return WALL_S + self._timeline.now + self.clock_error_s

    # ── life ──

    def start(self) -> None:
        """Start with nothing but the configuration and the event log."""
        now = self._timeline.now
        settings = dataclasses.replace(self._settings, policy=self.policy)
        self._core = ControlCore(settings, version_epoch=int(self._wall()) << 20, now=now)
        self._matcher = Matcher()
        self.events = EventLog(self._folder, wall=self._wall, clock=lambda: self._timeline.now)
        wall = self._wall()
        before = departures(self.events.events(), ran_until=self.events.ran_until, now_wall=wall, now=now)
        self._core.remember(*before, now)
        self._core.relay_revocations(self.crl, now)
        self.started_at = now
        self.starts += 1
        self.events.record(EventKind.STARTED)
        self._timeline.after(LOAD_EVERY_S, partial(self._follow_load, self._core))
        self._settle()

    def stop(self, *, orderly: bool) -> None:
        """End, either in an orderly way, or at once and silently."""
        lines = list(self._lines.values())
        assert self.events is not None
        if orderly:
            self.events.record(EventKind.STOPPED)
            for line in lines:
                line.close(CloseReason.STOPPING)
        self.events.close()
        self._core = None
        self._lines.clear()
        self._turn_at = float("inf")
        for line in lines:
            if not line.dead:
                line.cut()

    # ── streams ──

    def register(self, registration: Registration, line: Line) -> StreamId | Refusal:
        """Begin a stream."""
        if registration.name in self.barred:
            return Refusal.BAD_CREDENTIAL
        result = self.core.register(registration, self._timeline.now)
        assert self.events is not None
        if isinstance(result, Refusal):
            self.events.record(EventKind.REFUSED, registration.name, result.value)
            return result
        self.events.record(EventKind.CONNECTED, registration.name, "software day", role=registration.role)
        self._lines[result] = line
        self._settle()
        return result

    def receive(self, stream: StreamId, message: SidecarMessage) -> None:
        """Handle a message of a stream."""
        self.received += 1
        self.core.receive(stream, message, self._timeline.now)
        self._settle()

    def beat(self, stream: StreamId, heartbeat: Heartbeat) -> None:
        """Handle a heartbeat, which changes only the lease; a new Welcome may be due with it."""
        self.received += 1
        self.core.receive(stream, heartbeat, self._timeline.now)
        self._dispatch()

    def disconnected(self, stream: StreamId) -> None:
        """Handle the end of a stream."""
        self._lines.pop(stream, None)
        if self._core is not None:
            self._core.disconnected(stream, self._timeline.now)
            self._settle()

    # ── what the operator does ──

    def set_policy(self, policy: Policy | None) -> None:
        """Put another policy into force, now if it runs, else from its start on."""
        self.policy = policy
        if self._core is not None:
            self._core.set_policy(policy, self._timeline.now)
            self._settle()

    def revoke(self, name: NodeName, reason: RemovalReason, crl: bytes) -> None:
        """Invalidate a certificate."""
        self.barred.add(name)
        self.crl = crl
        if self._core is not None:
            self._core.relay_revocations(crl, self._timeline.now)
            self._core.part_with(name, reason, self._timeline.now)
            self._settle()

    # ── its loop ──

    def _follow_load(self, core: ControlCore) -> None:
        if core is self._core:
            core.follow_load(self._timeline.now, self.busy)
            self._timeline.after(LOAD_EVERY_S, partial(self._follow_load, core))

    def _settle(self) -> None:
        """Carry out what the core asks for, and schedule its next turn."""
        self._dispatch()
        due = self._core.next_timer() if self._core is not None else None
        if due is not None:
            due = max(due, self._turned_at + TURN_S)
            if due < self._turn_at:
                self._turn_at = due
                self._timeline.at(due, self._turn)

    def _turn(self) -> None:
        now = self._timeline.now
        if now < self._turn_at or self._core is None:
            return
        self._turn_at = float("inf")
        self._turned_at = now
        core = self._core
        core.handle_timer(now)
        picture = core.start_solving(now)
        if picture is not None:
            self.solved += 1
            plan = None
            if self._rng.randrange(FAILS_ONE_IN):
                plan = self._matcher.solve(picture.problem, time_limit_s=SOLVER_LIMIT_S, hint=core.plan)
            took_s = 0.01 + self._solving_s * len(picture.problem.blocks)
            self._timeline.after(took_s, partial(self._solved, core, picture, plan))
        self._settle()

    def _solved(self, core: ControlCore, picture: Picture, plan: Plan | None) -> None:
        if core is not self._core:
            return
        if plan is None:
            core.solving_failed(self._timeline.now)
        else:
            core.solved(core.settle(picture, plan, self._timeline.now), self._timeline.now)
        self._settle()

    def _dispatch(self) -> None:
        core, events = self._core, self.events
        if core is None or events is None:
            return
        while (event := core.next_event()) is not None:
            match event:
                case SendMessage(stream=stream, message=message):
                    self.sent += 1
                    if stream in self._lines:
                        self._lines[stream].put(message)
                case EndStream(stream=stream, reason=reason):
                    if stream in self._lines:
                        self._lines[stream].close(reason)
                case NackNotice(sidecar=name, nack=nack):
                    events.record(EventKind.NACK, name, nack.error)
                case OffersRefusedNotice(sidecar=name, services=services):
                    events.record(EventKind.OFFERS_REFUSED, name, services[0])
                case UnmetNotice(sidecar=name, services=services):
                    events.record(EventKind.UNMET, name, services[0])
                case DepartureNotice(sidecar=name, departure=gone):
                    seen_s = self._timeline.now - gone.seen_at
                    events.record(EventKind.DEPARTED, name, gone.text, role=gone.role, why=gone.why, seen_s=seen_s)
                case StreamLostNotice(sidecar=name, role=role):
                    events.record(EventKind.STREAM_LOST, name, role=role)
                case CutOffNotice(sidecar=name, role=role, lifted=lifted):
                    events.record(EventKind.REJOINED if lifted else EventKind.CUT_OFF, name, role=role)
