"""Simulates a fleet at a control plane's core: the registrations of robots and clouds, and the robots' reports."""

from __future__ import annotations

import random
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING

from plr.controlplane.core.control.control import ControlCore
from plr.controlplane.core.control.events import Settings
from plr.controlplane.core.publish.messages import SendMessage
from plr.controlplane.solver.matcher import Matcher
from plr.protos.base.histogram import Histogram
from plr.protos.model.ids import PROTOCOL_VERSION, InterfaceId, InterfaceName, NodeName, Role, ServiceName, SessionId
from plr.protos.model.mapping import Assignment, MappingSet
from plr.protos.model.members import (
    Candidate,
    CandidateKind,
    CandidateSet,
    Registration,
    ServiceOffer,
    ServiceSet,
    ServiceUse,
)
from plr.protos.model.report import JointReport, LatencyReport, OutcomeReport, PathReport, Report

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from plr.controlplane.core.registry.registry import StreamId

SERVICE = ServiceName("/bench")
TYPE = "nav_msgs/srv/GetPlan"
DEADLINE_S = 0.1
ROOM = 1.1
"""Capacity of all servers together over the demand of all robots."""
PROCESSING_S = 0.01
REQUESTS = 5
"""Requests of one robot between two reports."""
SOLVE_LIMIT_S = 60.0
SETTLE_S = 1.0
"""Time from the fleet's reports to a routine solving: long enough for it to be due."""


class Crowd:
    """Robots and clouds, each with one stream to the same core; time is simulated."""

    def __init__(self, robots: int, interfaces: int, servers: int, *, seed: int) -> None:
        self.now = 0.0
        self.core = ControlCore(Settings(lease_s=1e6, warm_up_s=0.0), version_epoch=1, now=0.0)
        self.matcher = Matcher()
        self.mappings: dict[NodeName, MappingSet] = {}
        self.turns: dict[str, list[float]] = {"report": [], "draw": [], "settle": []}
        """Seconds that each call of the core took; all streams of a control plane wait that long."""
        self._rng = random.Random(seed)
        self._owner: dict[StreamId, NodeName] = {}
        self._stream: dict[NodeName, StreamId] = {}
        self.robots = [NodeName(f"robot-{number:04d}") for number in range(robots)]
        self._servers = [NodeName(f"cloud-{number:02d}") for number in range(servers)]
        self._interfaces = [InterfaceName(f"if{number}") for number in range(interfaces)]
        self._rtt_s = {server: self._rng.uniform(0.01, 0.09) for server in self._servers}
        self._extra_s = {
            (robot, interface): self._rng.uniform(0.0, 0.04) for robot in self.robots for interface in self._interfaces
        }
        capacity = int(robots * interfaces * ROOM / servers)
        for server in self._servers:
            self._join(server, Role.CLOUD, ServiceSet((ServiceOffer(SERVICE, TYPE, capacity),), ()))
        for robot in self.robots:
            self._join(robot, Role.ROBOT, ServiceSet((), (ServiceUse(SERVICE, TYPE, DEADLINE_S, True),)))

    def _join(self, name: NodeName, role: Role, services: ServiceSet) -> None:
        registration = Registration(
            PROTOCOL_VERSION,
            name,
            role,
            SessionId(len(self._stream) + 1),
            name.encode().ljust(16, b"*")[:16],
            1,
            "bench",
        )
        stream = self.core.register(registration, self.now)
        if not isinstance(stream, int):
            raise RuntimeError(f"{name} is refused")
        self._stream[name] = stream
        self._owner[stream] = name
        interfaces = self._interfaces if role is Role.ROBOT else [InterfaceName("eth0")]
        candidates = tuple(
            Candidate(InterfaceId(number), interface, CandidateKind.HOST, ("10.0.0.1", 4000 + number))
            for number, interface in enumerate(interfaces)
        )
        self.core.receive(stream, CandidateSet(candidates), self.now)
        self.core.receive(stream, services, self.now)

    def report(self, robot: NodeName, *, dead: Collection[str] = ()) -> Report:
        """Return what a robot measured: probes over every path, requests over those of its mapping. No path over `dead`
        interfaces is up."""
        paths = []
        for interface in self._interfaces:
            for server in self._servers:
                rtt = Histogram()
                rtt.record(self._latency(robot, interface, server))
                paths.append(PathReport(interface, server, interface not in dead, rtt, 3))
        latencies = []
        chosen = self._chosen(robot)
        for pair in chosen:
            network, processing = Histogram(), Histogram()
            missed = 0
            for _ in range(REQUESTS):
                took = self._latency(robot, pair.interface, pair.server)
                missed += took + PROCESSING_S > DEADLINE_S
                network.record(took)
                processing.record(PROCESSING_S)
            latencies.append(
                LatencyReport(
                    pair.interface, pair.server, SERVICE, 0, network, Histogram(), processing, REQUESTS, missed
                )
            )
        joints = (JointReport(SERVICE, chosen[0], chosen[1], REQUESTS, 0),) if len(chosen) > 1 else ()
        return Report(tuple(latencies), tuple(paths), (OutcomeReport(SERVICE, REQUESTS),), joints)

    def _latency(self, robot: NodeName, interface: InterfaceName, server: NodeName) -> float:
        return (self._rtt_s[server] + self._extra_s[robot, interface]) * self._rng.lognormvariate(0.0, 0.2)

    def _chosen(self, robot: NodeName) -> tuple[Assignment, ...]:
        mapping = self.mappings.get(robot)
        return mapping.services[0].assignments if mapping is not None and mapping.services else ()

    def tell(self, robot: NodeName, report: Report) -> None:
        """Hand a report to the core."""
        with self._turn("report"):
            self.core.receive(self._stream[robot], report, self.now)

    @contextmanager
    def _turn(self, kind: str) -> Iterator[None]:
        began = time.perf_counter()
        yield
        self.turns[kind].append(time.perf_counter() - began)

    def tell_all(self) -> None:
        """Let all robots report, and make and send the plan that follows."""
        for robot in self.robots:
            self.tell(robot, self.report(robot))
        self.now += SETTLE_S
        self.core.handle_timer(self.now)
        self.solve()

    def solve(self) -> int:
        """Do what is due, as the driver does; return how many mappings were sent."""
        picture = None
        while picture is None:
            with self._turn("draw"):
                picture = self.core.start_solving(self.now)
        plan = self.matcher.solve(picture.problem, time_limit_s=SOLVE_LIMIT_S, hint=self.core.plan)
        with self._turn("settle"):
            self.core.solved(self.core.settle(picture, plan, self.now), self.now)
        return self.drain()

    def drain(self) -> int:
        """Take what the core sends; return how many mappings there were."""
        mappings = 0
        while (event := self.core.next_event()) is not None:
            if isinstance(event, SendMessage) and isinstance(event.message, MappingSet):
                self.mappings[self._owner[event.stream]] = event.message
                mappings += 1
        return mappings
