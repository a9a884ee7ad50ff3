"""Simulates what a robot that sends every request over both paths of a trace would see."""

from __future__ import annotations

import random
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

from plr.controlplane.planning.fifo import FifoPath

if TYPE_CHECKING:
    from lab.traces import Trace

ANSWER_BYTES = 1000
PROCESSING_MEDIAN_S = 0.02
PROCESSING_SIGMA = 0.25
"""Spread of the servers' log-normal time: a detector on a GPU that others use as well."""
PATHS = ("a", "b")
PROBE_BYTES = 100
PROBE_INTERVAL_S = 0.25


@dataclass(frozen=True, slots=True)
class Workload:
    """Requests of one size at a steady rate."""

    name: str
    size: int
    per_second: float


PINGS = (Workload("1 kB 10/s", 1000, 10.0),)
"""Workloads for a trace of pings, which does not show capacity."""
IMAGES = (Workload("20 kB 10/s", 20_000, 10.0), Workload("120 kB 5/s", 120_000, 5.0))
"""Small and large pictures; the latter as the paper's driving study sends them."""


@dataclass(frozen=True, slots=True)
class Race:
    """One request on every path: seconds until each answer, inf if lost, and each server's part of that time."""

    at_s: float
    latency_s: tuple[float, ...]
    processing_s: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Probe:
    """Round trip of a small packet on one path; inf if lost."""

    at_s: float
    path: int
    rtt_s: float


@dataclass(frozen=True, slots=True)
class Races:
    """All requests of one workload through one trace."""

    trace: str
    workload: Workload
    duration_s: float
    races: tuple[Race, ...]
    probes: tuple[Probe, ...]


def workloads_for(kind: str) -> tuple[Workload, ...]:
    """Return the workloads for a trace of this kind (`rtt` or `rate`)."""
    return PINGS if kind == "rtt" else IMAGES


def replay(trace: Trace, workload: Workload) -> Races:
    """Send the workload over both paths from the trace's start to its end; the result is the same every time."""
    rng = random.Random(zlib.crc32(f"{trace.name} {workload.name}".encode()))
    paths = [FifoPath(trace.path(name)) for name in PATHS]
    races: list[Race] = []
    probes: list[Probe] = []
    interval = 1.0 / workload.per_second
    for number in range(int(trace.duration_s * workload.per_second)):
        # Avoid sending in step with the trace, whose rows change at whole seconds.
        at = (number + rng.random()) * interval
        while len(probes) // 2 * PROBE_INTERVAL_S < at:
            probe_at = len(probes) // 2 * PROBE_INTERVAL_S
            probes += [
                Probe(probe_at, index, path.request(probe_at, PROBE_BYTES, PROBE_BYTES, 0.0, rng))
                for index, path in enumerate(paths)
            ]
        processing = (_processing(rng), _processing(rng))
        latency = [
            path.request(at, workload.size, ANSWER_BYTES, took, rng)
            for path, took in zip(paths, processing, strict=True)
        ]
        races.append(Race(at, (latency[0], latency[1]), processing))
    return Races(trace.name, workload, trace.duration_s, tuple(races), tuple(probes))


def _processing(rng: random.Random) -> float:
    return PROCESSING_MEDIAN_S * rng.lognormvariate(0.0, PROCESSING_SIGMA)
