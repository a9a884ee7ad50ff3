"""Crosses both interfaces of a trace with several servers whose load changes: a request's time on every pair."""

from __future__ import annotations

import math
import random
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bench.matcher.races import (
    ANSWER_BYTES,
    PATHS,
    PROBE_BYTES,
    PROBE_INTERVAL_S,
    PROCESSING_MEDIAN_S,
    PROCESSING_SIGMA,
    Probe,
    Race,
    Races,
)
from plr.controlplane.planning.fifo import FifoLink
from plr.protos.model.ids import InterfaceName, NodeName
from plr.protos.model.mapping import Assignment

if TYPE_CHECKING:
    from bench.matcher.races import Workload
    from lab.traces import Trace

EXTRA_RTT_S = (0.0, 0.01, 0.03)
"""Extra round trip of each server beyond the trace's own: in the city, in the country, on the continent."""
BUSY_FACTOR = 10.0
"""How many times longer a busy server takes: 0.2 s instead of 20 ms."""
BUSY_MEAN_S = 60.0
BUSY_LEAST_S = 20.0
"""Least time that one server is busy before load moves to another one, or to none."""


@dataclass(frozen=True, slots=True)
class Load:
    """Which server is busy when; None if none is."""

    times: tuple[float, ...]
    busy: tuple[int | None, ...]

    @classmethod
    def random(cls, servers: int, duration_s: float, rng: random.Random) -> Load:
        """Make load that moves on at random times, always to somewhere else."""
        times, busy = [0.0], [rng.choice((None, *range(servers)))]
        while times[-1] < duration_s:
            times.append(times[-1] + BUSY_LEAST_S + rng.expovariate(1.0 / (BUSY_MEAN_S - BUSY_LEAST_S)))
            busy.append(rng.choice([other for other in (None, *range(servers)) if other != busy[-1]]))
        return cls(tuple(times), tuple(busy))

    def at(self, now: float, start: int) -> int:
        """Return the stretch that contains `now`, searching from stretch `start` on."""
        while start + 1 < len(self.times) and self.times[start + 1] <= now:
            start += 1
        return start


def pairs_of(servers: int, interfaces: tuple[str, ...] = PATHS) -> tuple[Assignment, ...]:
    """Return all pairs of an interface and a server, in the order of a crossed race's paths."""
    return tuple(
        Assignment(InterfaceName(path), NodeName(f"cloud-{server}")) for path in interfaces for server in range(servers)
    )


class _Crossing:
    """One interface: all requests share its uplink, whatever the server; each server's answers have their own way."""

    def __init__(self, trace: Trace, path: str, servers: int) -> None:
        steps = trace.path(path)
        self._up = FifoLink(steps, up=True)
        self._down = [FifoLink(steps, up=False) for _ in range(servers)]

    def send(self, at: float, size: int, answer: int, processing: tuple[float, ...], rng: random.Random) -> list[float]:
        """Return the seconds until each server's answer; inf if lost."""
        arrived = self._up.send(at, size, rng)
        if math.isinf(arrived):
            return [math.inf] * len(self._down)
        return [
            down.send(arrived + EXTRA_RTT_S[server] / 2 + took, answer, rng) + EXTRA_RTT_S[server] / 2 - at
            for server, (down, took) in enumerate(zip(self._down, processing, strict=True))
        ]


def cross(trace: Trace, workload: Workload, servers: int) -> Races:
    """Send the workload over both interfaces to all servers; the result is the same every time."""
    rng = random.Random(zlib.crc32(f"{trace.name} {workload.name} {servers}".encode()))
    load = Load.random(servers, trace.duration_s, rng)
    crossings = [_Crossing(trace, path, servers) for path in PATHS]
    races: list[Race] = []
    probes: list[Probe] = []
    interval = 1.0 / workload.per_second
    stretch = probed = 0
    for number in range(int(trace.duration_s * workload.per_second)):
        at = (number + rng.random()) * interval
        while probed * PROBE_INTERVAL_S < at:
            sent = probed * PROBE_INTERVAL_S
            rtts = [c.send(sent, PROBE_BYTES, PROBE_BYTES, (0.0,) * servers, rng) for c in crossings]
            probes += [Probe(sent, path, rtt) for path, rtt in enumerate(rtts[0] + rtts[1])]
            probed += 1
        stretch = load.at(at, stretch)
        processing = tuple(
            PROCESSING_MEDIAN_S
            * rng.lognormvariate(0.0, PROCESSING_SIGMA)
            * (BUSY_FACTOR if load.busy[stretch] == server else 1.0)
            for server in range(servers)
        )
        latency = [seconds for c in crossings for seconds in c.send(at, workload.size, ANSWER_BYTES, processing, rng)]
        races.append(Race(at, tuple(latency), processing * len(PATHS)))
    return Races(trace.name, workload, trace.duration_s, tuple(races), tuple(probes))
