"""What an oracle gets over both paths: it knows the whole trace, and each request shares the two.

The ideal (`bench.evaluation.ideal`) is no bound, as it sends whole requests down both paths and gives none up. This one
sends the bytes of each request over both at once, as many as each path bears, so that both parts end together. What
cannot be in time is not sent at all. Requests go in the order in which they are due: giving up one that could be in
time may save two, so even this is no strict bound. Nothing is lost, and servers are never busy. No program can do it,
because none knows what a path will bear.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from bench.evaluation.ideal import ORACLE
from bench.evaluation.outcome import Outcome, Request
from controlplane.planning.fifo import FifoLink

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bench.evaluation.scenario import Scenario, Traffic
    from controlplane.planning.fifo import Step

OVERHEAD = 1.05
"""Bytes of IP packets for each byte of a request."""
_HALVINGS = 40


class _Path:
    """One path to an idle server."""

    def __init__(self, steps: Sequence[Step], traffic: Traffic) -> None:
        self._up = FifoLink(steps, up=True)
        self._down = FifoLink(steps, up=False)
        self._compute_s = traffic.compute_ms / 1e3
        self._answer_bytes = traffic.answer_bytes
        self.free_s = 0.0
        """When what was sent so far has left."""

    def answered(self, left_s: float) -> float:
        """When the answer is here, if the request has left at `left_s`."""
        starts = left_s + self._up.delay_at(left_s) + self._compute_s
        back = self._down.time_of(self._down.capacity_by(starts) + self._answer_bytes)
        return back if math.isinf(back) else back + self._down.delay_at(back)

    def last_use(self, begin_s: float, deadline_s: float) -> float:
        """Until when bytes may leave so that the answer is in time; `begin_s` if they never may."""
        if self.answered(begin_s) > deadline_s:
            return begin_s
        early, late = begin_s, deadline_s
        for _ in range(_HALVINGS):
            middle = (early + late) / 2
            early, late = (middle, late) if self.answered(middle) <= deadline_s else (early, middle)
        return early

    def room(self, begin_s: float, end_s: float) -> float:
        """Bytes that can leave between the two."""
        return self._up.capacity_by(end_s) - self._up.capacity_by(begin_s)


def compute(scenario: Scenario) -> Outcome:
    """The oracle's outcome; always the same. What it gives up has no answer."""
    traffic = scenario.traffic
    trace = scenario.trace()
    paths = [_Path(trace.path(name), traffic) for name in ("a", "b")]
    requests = []
    for number in range(scenario.count):
        due_s = number / traffic.rate_hz
        answered_s = _send(paths, due_s, due_s + traffic.deadline_ms / 1e3, traffic.request_bytes * OVERHEAD)
        requests.append(Request(due_s, None if answered_s is None else due_s, answered_s))
    return Outcome(scenario.name, scenario.case, ORACLE, traffic.deadline_ms, tuple(requests))


def _send(paths: Sequence[_Path], due_s: float, deadline_s: float, size: float) -> float | None:
    """Send one request over both paths; when it is answered, or None, and nothing is sent: it cannot be in time."""
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
