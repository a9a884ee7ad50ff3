"""The control plane's core against changing networks and servers, as they come: what its mappings would have missed.

It sees what a robot's sidecar would report, no more: the requests that went over mapped pairs, a few that explored
others, and probes of every pair.
"""

from __future__ import annotations

import itertools
import math
import random
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bench.matcher.choosing import RTT_MEMORY
from bench.matcher.crossed import pairs_of
from bench.matcher.feed import REPORT_INTERVAL_S, ROBOT, SERVICE, Reporter
from bench.matcher.races import ANSWER_BYTES, PATHS
from controlplane.core.control import ControlCore
from controlplane.core.control_events import Send, Settings
from controlplane.core.registry import Refusal
from controlplane.matcher import Matcher
from protos.model import (
    PROTOCOL_VERSION,
    Candidate,
    CandidateKind,
    CandidateSet,
    InterfaceId,
    InterfaceName,
    MappingSet,
    NodeName,
    Registration,
    Role,
    ServiceMapping,
    ServiceOffer,
    ServiceSet,
    ServiceUse,
    SessionId,
)
from sidecar.core.copies import OBSERVED_ONE_IN
from sidecar.core.exploration import ExplorationBudget
from sidecar.service_config import DEFAULT_EXPLORATION

if TYPE_CHECKING:
    from bench.matcher.races import Races
    from controlplane.core.registry import StreamId
    from protos.model import SidecarMessage

RIVALS = ("best fixed", "random", "round robin", "lowest mean RTT")
FOREVER_S = 1e9
JOINED_S = -2.0
"""When all have come, before the first request."""
SOLVER_LIMIT_S = 1.0
TYPE = "bench/srv/Detect"

Mapping = tuple[int, ...]
"""For each interface the server."""


@dataclass(frozen=True, slots=True)
class Online:
    """Misses of every way to map, over one trace, workload and deadline."""

    trace: str
    servers: int
    requests: int
    duration_s: float
    misses: dict[str, float]
    switches: int
    """How often the matcher's mapping changed."""
    explored: int
    """Copies sent to explore."""


class _Plane:
    """A control plane with one robot and its servers."""

    def __init__(self, servers: int, deadline_s: float) -> None:
        settings = Settings(lease_s=FOREVER_S, warm_up_s=0.0, report_interval_s=REPORT_INTERVAL_S)
        self._core = ControlCore(settings, version_epoch=1, now=JOINED_S)
        self._matcher = Matcher()
        for server in range(servers):
            services = ServiceSet(offers=(ServiceOffer(SERVICE, TYPE),))
            self._join(NodeName(f"cloud-{server}"), Role.CLOUD, ("eth0",), services)
        services = ServiceSet(uses=(ServiceUse(SERVICE, TYPE, deadline_s, True),))
        self._robot = self._join(ROBOT, Role.ROBOT, PATHS, services)
        self.mapping: ServiceMapping | None = None
        self._advance(JOINED_S / 2)

    def _join(self, name: NodeName, role: Role, interfaces: tuple[str, ...], services: ServiceSet) -> StreamId:
        session = SessionId(zlib.crc32(name.encode()))
        stream = self._core.register(
            Registration(PROTOCOL_VERSION, name, role, session, name.encode().ljust(16, b"*"), 1, "bench"), JOINED_S
        )
        if isinstance(stream, Refusal):
            raise TypeError(stream)
        candidates = tuple(
            Candidate(InterfaceId(number), InterfaceName(interface), CandidateKind.HOST, ("10.0.0.1", 4000 + number))
            for number, interface in enumerate(interfaces)
        )
        self._core.receive(stream, CandidateSet(candidates), JOINED_S)
        self._core.receive(stream, services, JOINED_S)
        return stream

    def take(self, message: SidecarMessage, now: float) -> None:
        """The robot says this; the mapping that follows is in force at once."""
        self._core.receive(self._robot, message, now)
        self._advance(now)

    def _advance(self, now: float) -> None:
        self._core.handle_timer(now)
        picture = self._core.start_solving(now)
        if picture is not None:
            plan = self._matcher.solve(picture.problem, time_limit_s=SOLVER_LIMIT_S, hint=self._core.plan)
            self._core.solved(picture, plan, now)
        while (event := self._core.next_event()) is not None:
            if isinstance(event, Send) and event.stream == self._robot and isinstance(event.message, MappingSet):
                self.mapping = next(iter(event.message.services), None)


def follow(races: Races, deadline_s: float, servers: int) -> Online:
    """Replay the requests with whatever mapping the control plane has told by then, and by its rivals' choices."""
    pairs = pairs_of(servers)
    number_of = {pair: number for number, pair in enumerate(pairs)}
    rng = random.Random(zlib.crc32(f"{races.trace} {servers}".encode()))
    size = races.workload.size + ANSWER_BYTES
    reporter, plane = Reporter(deadline_s, rng, size=size, pairs=pairs), _Plane(servers, deadline_s)
    probes, waiting = iter(races.probes), iter(races.races)
    probe, race = next(probes, None), next(waiting, None)
    carried: tuple[int, ...] = ()
    budget = ExplorationBudget(0.0)
    rtts: dict[int, float] = {}
    """Of the last probe of each path: a request in trouble takes the best one."""
    missed = 0.0
    switches = explored = 0
    for tick in range(math.ceil(races.duration_s / REPORT_INTERVAL_S)):
        now = tick * REPORT_INTERVAL_S
        plane.take(reporter.take(now), now)
        mapping = plane.mapping
        before = carried
        carried = tuple(number_of[pair] for pair in mapping.assignments) if mapping is not None else ()
        switches += bool(before) and set(before) != set(carried)
        explore = number_of[mapping.explore] if mapping is not None and mapping.explore is not None else None
        while probe is not None and probe.at_s < now + REPORT_INTERVAL_S:
            reporter.probed(probe)
            rtts[probe.path] = probe.rtt_s
            probe = next(probes, None)
        while race is not None and race.at_s < now + REPORT_INTERVAL_S:
            late = min((race.latency_s[path] for path in carried), default=math.inf) > deadline_s
            missed += late
            full = not rng.randrange(OBSERVED_ONE_IN)
            budget.earn(DEFAULT_EXPLORATION, race.at_s)
            if full and explore is not None and budget.suffices(race.at_s):
                reporter.raced(race, (*carried, explore), full=full)
                budget.spend(race.at_s)
                explored += 1
            elif carried:
                reporter.raced(race, carried, full=full)
            if late and full:
                idle = [path for path in rtts if path % servers not in {sent % servers for sent in carried}]
                if idle:
                    reporter.rescued(race, min(idle, key=lambda path: rtts[path]))
            race = next(waiting, None)
    misses = {"matcher": missed} | _rivals(races, deadline_s, servers)
    return Online(races.trace, servers, len(races.races), races.duration_s, misses, switches, explored)


def _rivals(races: Races, deadline_s: float, servers: int) -> dict[str, float]:
    mappings: list[Mapping] = list(itertools.permutations(range(servers), len(PATHS)))
    late = np.array([race.latency_s for race in races.races]) > deadline_s
    ticks = np.array([int(race.at_s / REPORT_INTERVAL_S) for race in races.races])
    both = np.array(
        [np.logical_and.reduce([late[:, i * servers + j] for i, j in enumerate(mapping)]) for mapping in mappings]
    )
    every = np.arange(len(ticks))
    chance = random.Random(len(ticks))
    by_lot = np.array([chance.randrange(len(mappings)) for _ in range(int(ticks.max()) + 1)])
    nearest = np.array([mappings.index(mapping) for mapping in _lowest_rtt(races, servers, int(ticks.max()) + 1)])
    return {
        "best fixed": float(both.sum(axis=1).min()),
        "random": float(both[by_lot[ticks], every].sum()),
        "round robin": float(both[ticks % len(mappings), every].sum()),
        "lowest mean RTT": float(both[nearest[ticks], every].sum()),
    }


def _lowest_rtt(races: Races, servers: int, ticks: int) -> list[Mapping]:
    """For each interval: pair after pair by the mean round trip of the probes answered so far, lowest first."""
    means = [0.0] * (len(PATHS) * servers)
    chosen: list[Mapping] = []
    probes = iter(races.probes)
    probe = next(probes, None)
    for tick in range(ticks):
        while probe is not None and probe.at_s < tick * REPORT_INTERVAL_S:
            if probe.rtt_s < 1.0:
                before = means[probe.path] or probe.rtt_s
                means[probe.path] = RTT_MEMORY * before + (1.0 - RTT_MEMORY) * probe.rtt_s
            probe = next(probes, None)
        taken: dict[int, int] = {}
        for path in sorted(range(len(means)), key=lambda path: means[path]):
            interface, server = divmod(path, servers)
            if interface not in taken and server not in taken.values():
                taken[interface] = server
        chosen.append(tuple(taken[interface] for interface in range(len(PATHS))))
    return chosen
