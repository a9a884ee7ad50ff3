"""What two first-in-first-out paths would have given, computed from the trace: nothing is run.

Each path is first in, first out in both directions (`controlplane.planning.fifo`) and carries every request; the ideal
takes, for each request, the faster of the two. Nobody calls losers off or shares a request out here, so it is no bound:
a system that does can be better where a queue builds up. `bench.evaluation.oracle` is nearer to a bound.
"""

from __future__ import annotations

import math
import random
import zlib
from typing import TYPE_CHECKING

from bench.dataplane.calling import Compute
from bench.evaluation.outcome import Outcome, Request
from controlplane.planning.fifo import FifoPath

if TYPE_CHECKING:
    from bench.evaluation.scenario import Scenario

IDEALS = {"ideal": ("a", "b"), "ideal-a": ("a",), "ideal-b": ("b",)}
"""Both paths, and each alone."""
ORACLE = "oracle"
COMPUTED = (*IDEALS, ORACLE)
"""Contenders that are not run; `bench.evaluation.oracle` has the last."""


def compute(scenario: Scenario, contender: str) -> Outcome:
    """The outcome of one of `IDEALS`; always the same."""
    traffic = scenario.traffic
    trace = scenario.trace()
    names = IDEALS[contender]
    paths = [
        (
            FifoPath(trace.path(name)),
            Compute(**traffic.compute(first=name == names[0])),
            # What a path loses is the same with the other path and without.
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
