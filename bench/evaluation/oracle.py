"""Computes what an oracle achieves over both paths: it knows the whole trace, and splits each request over the two.

The ideal (`bench.evaluation.ideal`) is no bound, since it sends whole requests down both paths and gives none up. The
oracle sends the bytes of each request over both at once, as many as each path carries, so that both parts end together.
A request that cannot be in time is not sent at all. Requests go in the order in which they are due: giving up one that
could be in time may save two, so even this is no strict bound. Nothing is lost, and servers are never busy. No program
can do this, because none knows what a path will carry.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from bench.evaluation.ideal import ORACLE
from bench.evaluation.outcome import Outcome, Request
from plr.controlplane.planning.fifo import FifoLink

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bench.evaluation.scenario import Scenario, Traffic
    from plr.controlplane.planning.fifo import Step

OVERHEAD = 1.05
"""Bytes of IP packets for each byte of a request."""
_HALVINGS = 40


class OraclePath:
    """One path to an idle server."""

    def __init__(self, steps: Sequence[Step], traffic: Traffic) -> None:
        self.up = FifoLink(steps, up=True)
        self._down = FifoLink(steps, up=False)
        self._compute_s = traffic.compute_ms / 1e3
        self._answer_bytes = traffic.answer_bytes
        self.free_s = 0.0
        """When everything sent so far has left."""

    def answered(self, left_s: float) -> float:
        """Return when the answer arrives, if the request has left at `left_s`."""
        starts = left_s + self.up.delay_at(left_s) + self._compute_s
        back = self._down.time_of(self._down.capacity_by(starts) + self._answer_bytes)
        return back if math.isinf(back) else back + self._down.delay_at(back)

    def last_use(self, begin_s: float, deadline_s: float) -> float:
        """Return until when bytes may leave so that the answer is in time; `begin_s` if they never may."""
        if self.answered(begin_s) > deadline_s:
            return begin_s
        early, late = begin_s, deadline_s
        for _ in range(_HALVINGS):
            middle = (early + late) / 2
            early, late = (middle, late) if self.answered(middle) <= deadline_s else (early, middle)
        return early

    def end_of(self, begin_s: float, size: float) -> float:
        """Return when this many bytes have left that begin to leave at `begin_s`; inf if the trace ends before."""
        return self.up.time_of(self.up.capacity_by(begin_s) + size)

    def room(self, begin_s: float, end_s: float) -> float:
        """Return the bytes that can leave between the two times."""
        return self.up.capacity_by(end_s) - self.up.capacity_by(begin_s)


def compute(scenario: Scenario) -> Outcome:
    """Return the oracle's outcome, which is always the same. A request that it gives up has no answer."""
    traffic = scenario.traffic
    trace = scenario.trace()
    paths = [OraclePath(trace.path(name), traffic) for name in ("a", "b")]
    requests = []
    for number in range(scenario.count):
        due_s = number / traffic.rate_hz
        answered_s = _send(paths, due_s, due_s + traffic.deadline_ms / 1e3, traffic.request_bytes * OVERHEAD)
        requests.append(Request(due_s, None if answered_s is None else due_s, answered_s))
    return Outcome(scenario.name, scenario.case, ORACLE, traffic.deadline_ms, tuple(requests))


def _send(paths: Sequence[OraclePath], due_s: float, deadline_s: float, size: float) -> float | None:
    """Send a request over both paths and return when it is answered; if it cannot be in time, send nothing: None."""
    spans = [(path, begin := max(path.free_s, due_s), path.last_use(begin, deadline_s)) for path in paths]
    used = [(path, begin, end) for path, begin, end in spans if end > begin]

    def room(until_s: float) -> float:
        return sum(path.room(begin, min(until_s, end)) for path, begin, end in used if until_s > begin)

    early, late = due_s, deadline_s
    if room(late) < size:
        return None
    for _ in range(_HALVINGS):
        middle = (early + late) / 2
        early, late = (early, middle) if room(middle) >= size else (middle, late)
    ends = [(path, min(late, end)) for path, begin, end in used if late > begin]
    for path, end in ends:
        path.free_s = end
    return max(path.answered(end) for path, end in ends)
