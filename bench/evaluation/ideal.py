"""Computes from the trace what two first-in-first-out paths would have achieved; nothing is run.

Each path is first in, first out in both directions (`plr.controlplane.planning.fifo`) and carries every request; the
ideal takes, for each request, the faster of the two. It neither cancels losing copies nor splits a request, so it is no
bound: a system that does can be better where a queue builds up. `bench.evaluation.oracle` is closer to a bound.
"""

from __future__ import annotations

import math
import random
import zlib
from typing import TYPE_CHECKING

from bench.dataplane.calling import Compute
from bench.evaluation.outcome import Outcome, Request
from plr.controlplane.planning.fifo import FifoPath

if TYPE_CHECKING:
    from bench.evaluation.scenario import Scenario

IDEALS = {"ideal": ("a", "b"), "ideal-a": ("a",), "ideal-b": ("b",)}
"""Paths of each ideal: both, and each alone."""
ORACLE = "oracle"
COMPUTED = (*IDEALS, ORACLE)
"""Contenders that are computed, not run; `bench.evaluation.oracle` computes the last."""


def compute(scenario: Scenario, contender: str) -> Outcome:
    """Return the outcome of one of `IDEALS`; it is always the same."""
    traffic = scenario.traffic
    trace = scenario.trace()
    names = IDEALS[contender]
    paths = [
        (
            FifoPath(trace.path(name)),
            Compute(**traffic.compute(first=name == names[0])),
            # A path loses the same packets with and without the other path.
            random.Random(zlib.crc32(f"{scenario.name} {name}".encode())),
        )
        for name in names
    ]
    requests = []
    for number in range(scenario.count):
        due_s = number / traffic.rate_hz
        latency_s = min(
            path.request(due_s, traffic.request_bytes, traffic.answer_bytes, server.next_s(), rng)
            for path, server, rng in paths
        )
        requests.append(Request(due_s, due_s, None if math.isinf(latency_s) else due_s + latency_s))
    return Outcome(scenario.name, scenario.case, contender, traffic.deadline_ms, tuple(requests))
