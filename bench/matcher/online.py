"""Replays changing networks and servers to the control plane's core, and counts what its mappings would have missed.

The core sees only what a robot's sidecar would report: the requests over mapped pairs, a few that explored others, and
probes of every pair.
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
from bench.matcher.feed import REPORT_INTERVAL_S, Reporter
from bench.matcher.plane import Plane
from bench.matcher.races import ANSWER_BYTES, PATHS
from plr.sidecar.config.service import DEFAULT_EXPLORATION
from plr.sidecar.core.base.request_id import OBSERVED_ONE_IN
from plr.sidecar.core.robot.dispatch.exploration import ExplorationBudget

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from bench.matcher.races import Races
    from plr.protos.model.mapping import Assignment, ServiceMapping

RIVALS = ("best fixed", "random", "round robin", "lowest mean RTT")
Mapping = tuple[int, ...]
"""The server of each interface."""


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


@dataclass(frozen=True, slots=True)
class Tick:
    """What happened between two reports."""

    at_s: float
    mapping: ServiceMapping | None
    carried: tuple[int, ...]
    """The pairs that carried each request, by number."""
    missed: int
    """Requests whose copies were all late."""
    explored: int


def replayed(races: Races, deadline_s: float, pairs: Sequence[Assignment]) -> Iterator[Tick]:
    """Replay the requests with the mapping that the control plane has sent by then."""
    number_of = {pair: number for number, pair in enumerate(pairs)}
    servers = len({pair.server for pair in pairs})
    rng = random.Random(zlib.crc32(f"{races.trace} {servers}".encode()))
    size = races.workload.size + ANSWER_BYTES
    reporter, plane = Reporter(deadline_s, rng, size=size, pairs=tuple(pairs)), Plane(pairs, deadline_s)
    probes, waiting = iter(races.probes), iter(races.races)
    probe, race = next(probes, None), next(waiting, None)
    budget = ExplorationBudget(0.0)
    rtts: dict[int, float] = {}
    """Round trip of the last probe of each path: a request in trouble takes the best path."""
    for tick in range(math.ceil(races.duration_s / REPORT_INTERVAL_S)):
        now = tick * REPORT_INTERVAL_S
        missed = explored = 0
        plane.take(reporter.take(now), now)
        mapping = plane.mapping
        carried = tuple(number_of[pair] for pair in mapping.assignments) if mapping is not None else ()
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
        yield Tick(now, mapping, carried, missed, explored)


def follow(races: Races, deadline_s: float, servers: int) -> Online:
    """Replay the requests over both interfaces to this many servers, and by the rivals' choices."""
    ticks = list(replayed(races, deadline_s, pairs_of(servers)))
    switches = sum(
        bool(before.carried) and set(before.carried) != set(after.carried)
        for before, after in itertools.pairwise(ticks)
    )
    misses = {"matcher": float(sum(tick.missed for tick in ticks))} | _rivals(races, deadline_s, servers)
    explored = sum(tick.explored for tick in ticks)
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
    """Return for each interval the pairs by mean round trip of the probes answered so far, lowest first."""
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
