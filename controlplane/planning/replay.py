"""Sends requests through recorded paths, as if over one interface or both, and to one server or two."""

from __future__ import annotations

import math
import random
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from plr.controlplane.core.estimate.posterior import IGNORANCE
from plr.controlplane.planning.fifo import FifoPath
from plr.controlplane.planning.prospects import Prospect
from plr.controlplane.planning.traces import PATHS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from plr.controlplane.planning.traces import RecordedPaths
    from plr.controlplane.planning.workload import Workload

    Latencies = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Replayed:
    """Seconds until the first answer of each request, inf if none came."""

    alone: tuple[Latencies, Latencies]
    """Latencies over each path by itself."""
    one_server: Latencies
    """Latencies over both paths to one server, which runs each request once."""
    two_servers: Latencies
    """Latencies over both paths, each to a server of its own."""


def replay(trace: RecordedPaths, workload: Workload) -> Replayed:
    """Send the workload from the trace's start to its end; the result is the same every time.

    No copy is cancelled when the first answer arrives, so queues are no shorter than they would be.
    """
    rng = random.Random(zlib.crc32(trace.name.encode()))  # noqa: S311 - no secret depends on it
    paths = [FifoPath(trace.paths[name]) for name in PATHS]
    # Answers of a single server go down in another order.
    shared = [FifoPath(trace.paths[name]).down for name in PATHS]
    alone: tuple[list[float], list[float]] = ([], [])
    one_server: list[float] = []
    interval = 1.0 / workload.rate_hz
    for number in range(int(trace.duration_s * workload.rate_hz)):
        # Avoid sending in step with the trace, whose rows change at whole seconds.
        at = (number + rng.random()) * interval
        computes = [workload.compute.draw(rng) for _ in PATHS]
        arrivals = [path.up.send(at, workload.request_bytes, rng) for path in paths]
        for found, path, arrived, compute in zip(alone, paths, arrivals, computes, strict=True):
            answered = path.down.send(arrived + compute, workload.answer_bytes, rng) if arrived < math.inf else math.inf
            found.append(answered - at)
        done = min(arrivals) + computes[0]
        one_server.append(
            min(
                (
                    down.send(max(done, arrived), workload.answer_bytes, rng)
                    for down, arrived in zip(shared, arrivals, strict=True)
                    if arrived < math.inf
                ),
                default=math.inf,
            )
            - at
        )
    first, second = (np.array(found) for found in alone)
    return Replayed((first, second), np.array(one_server), np.minimum(first, second))


class ReplayedTraces:
    """Several traces, pooled as if the robot had driven through one after the other."""

    def __init__(self, traces: Sequence[RecordedPaths], workload: Workload) -> None:
        replayed = [replay(trace, workload) for trace in traces]
        self._alone = [np.concatenate([found.alone[path] for found in replayed]) for path in range(len(PATHS))]
        self._one_server = np.concatenate([found.one_server for found in replayed])
        self._two_servers = np.concatenate([found.two_servers for found in replayed])
        self.requests = float(len(self._two_servers))
        compute = workload.compute
        self.title = (
            f"{len(traces)} trace{'s' if len(traces) > 1 else ''}, {len(self._two_servers)} requests of"
            f" {workload.request_bytes} bytes, {workload.rate_hz:g} a second, answers of {workload.answer_bytes} bytes,"
            f" servers take {compute.median_s * 1e3:g} ms (P99 {compute.p99_s * 1e3:g} ms)"
        )

    def prospects(self, deadline_s: float) -> list[Prospect]:
        """Return one interface, both to one server, and both to two."""
        singles = [_share_over(latencies, deadline_s) for latencies in self._alone]
        best = min(singles)
        product = math.prod(singles)
        both = " and ".join(PATHS)
        return [
            Prospect(1, 1, PATHS[singles.index(best)], best, best),
            Prospect(2, 1, both, product, _share_over(self._one_server, deadline_s)),
            Prospect(2, 2, both, product, _share_over(self._two_servers, deadline_s)),
        ]


def _share_over(latencies: Latencies, deadline_s: float) -> float:
    """Return the expected share of requests that miss; it is above 0 even if none was seen to miss."""
    missed = float(np.count_nonzero(latencies > deadline_s))
    return (missed + IGNORANCE.misses) / (len(latencies) + IGNORANCE.weight)
