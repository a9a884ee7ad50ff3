"""Computes what fluid models of two paths achieve: how far from the possible a transport is.

*Causal* oracles know each path's rate as it was a round trip ago, keep PIPE x rate x round trip in flight, cannot take
back what has left, and learn of an answer when it arrives. A path with room takes bytes of the most urgent request that
can still be in time. `whole`: a request's bytes count for each path apart, as copies do. `shared`: they count together.
`repair`: a path with nothing else to send repeats what others carry.
The *clairvoyant* knows the whole trace and sends whole requests; `bench.evaluation.oracle` is the one that shares.

In all of them the uplink needs OVERHEAD for headers, servers are never busy, and nothing is lost at random.
"""

from __future__ import annotations

import enum
import math
from collections import deque
from typing import TYPE_CHECKING

from bench.evaluation.oracle import OVERHEAD
from bench.evaluation.oracle import OraclePath as Path
from bench.evaluation.outcome import UNANSWERED_S, Outcome, Request

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from bench.evaluation.scenario import Scenario

STEP_S = 0.004
"""Step of the fluid models."""
PIPE = 1.25
LEAST_IN_FLIGHT = 12_000.0
"""Bytes that may always be in flight."""
_NEARLY = 1e-6


class Causal(enum.StrEnum):
    """What a causal oracle may do."""

    WHOLE = "causal-whole"
    SHARED = "causal-shared"
    REPAIR = "causal-repair"


class _Sender:
    """One path of a causal oracle, and what is in flight on it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.queued: deque[tuple[int, float]] = deque()
        """Bytes in flight before the bottleneck, by request."""
        self.acks: deque[tuple[float, float]] = deque()
        self.in_flight = 0.0
        self.known_rate = 0.0
        self.round_trip_s = 0.0

    def deliver(self, now: float) -> Iterator[tuple[int, float]]:
        """Yield what reaches the far end in this step, as (request, bytes), and take the acknowledgements due."""
        self.round_trip_s = 2.0 * self.path.up.delay_at(now)
        self.known_rate = self.path.up.rate_at(max(0.0, now - self.round_trip_s))
        room = self.path.up.rate_at(now) * STEP_S
        while room > 0.0 and self.queued:
            request, left = self.queued.popleft()
            moved = min(left, room)
            room -= moved
            if moved < left - _NEARLY:
                self.queued.appendleft((request, left - moved))
            self.acks.append((now + self.round_trip_s, moved))
            yield request, moved
        while self.acks and self.acks[0][0] <= now:
            self.in_flight -= self.acks.popleft()[1]

    def room(self) -> float:
        """Return the bytes that may leave."""
        return max(LEAST_IN_FLIGHT, PIPE * self.known_rate * (self.round_trip_s + STEP_S)) - self.in_flight

    def send(self, request: int, size: float) -> None:
        """Let these bytes leave."""
        self.queued.append((request, size))
        self.in_flight += size


class _Sent:
    """What has left of one request, and what has arrived, by path."""

    def __init__(self, due_s: float, deadline_s: float, paths: int) -> None:
        self.due_s = due_s
        self.deadline_s = deadline_s
        self.left = [0.0] * paths
        self.arrived = [0.0] * paths
        self.answered_s = math.inf


def causal(scenario: Scenario, kind: Causal) -> Outcome:
    """Return what this oracle achieves; always the same."""
    traffic = scenario.traffic
    trace = scenario.trace()
    senders = [_Sender(Path(trace.path(name), traffic)) for name in ("a", "b")]
    shares = kind is not Causal.WHOLE
    size = traffic.request_bytes * OVERHEAD
    server_s = traffic.compute_ms / 1e3
    dues = [number / traffic.rate_hz for number in range(scenario.count)]
    requests = [_Sent(due, due + traffic.deadline_ms / 1e3, len(senders)) for due in dues]
    sent = [0.0] * len(senders)
    begun = 0
    active: list[int] = []
    for step in range(int((dues[-1] + UNANSWERED_S) / STEP_S)):
        now = step * STEP_S
        while begun < len(dues) and dues[begun] <= now + _NEARLY:
            active.append(begun)
            begun += 1
        active = [one for one in active if requests[one].answered_s > now and requests[one].deadline_s > now]
        for place, sender in enumerate(senders):
            for number, moved in sender.deliver(now):
                request = requests[number]
                request.arrived[place] += moved
                arrived = sum(request.arrived) if shares else request.arrived[place]
                if arrived >= size - _NEARLY:
                    request.answered_s = min(request.answered_s, sender.path.answered(now + STEP_S))
        for place, sender in enumerate(senders):
            room = sender.room()
            if room <= 0.0 or not active:
                continue
            rate = max(1.0, sum(each.known_rate for each in senders) if shares else sender.known_rate)
            for number, most in _order(active, requests, place, kind, size, now, rate, sender.round_trip_s + server_s):
                moved = min(room, most)
                sender.send(number, moved)
                requests[number].left[place] += moved
                sent[place] += moved
                room -= moved
                if room <= 0.0:
                    break
    found = tuple(
        Request(one.due_s, one.due_s, one.answered_s if math.isfinite(one.answered_s) else None) for one in requests
    )
    weight = {name: round(size) for name, size in zip(("a", "b"), sent, strict=True)}
    return Outcome(scenario.name, scenario.case, kind.value, traffic.deadline_ms, found, weight)


def _order(
    active: Sequence[int],
    requests: Sequence[_Sent],
    place: int,
    kind: Causal,
    size: float,
    now: float,
    rate: float,
    after_s: float,
) -> list[tuple[int, float]]:
    """Return what a path may take, in order, as (request, bytes at most): what can be in time goes first."""
    shares = kind is not Causal.WHOLE
    left = [(one, size - (sum(requests[one].left) if shares else requests[one].left[place])) for one in active]
    first = [(one, most) for one, most in left if most > _NEARLY]

    def in_time(of: tuple[int, float]) -> bool:
        return now + of[1] / rate + after_s <= requests[of[0]].deadline_s

    order = [of for of in first if in_time(of)] + [of for of in first if not in_time(of)]
    if kind is Causal.REPAIR:
        order += [
            (one, size - requests[one].left[place])
            for one, most in left
            if most <= _NEARLY and requests[one].left[place] < size - _NEARLY
        ]
    return order


def clairvoyant_misses(scenario: Scenario) -> int:
    """Return the fewest requests that miss if each goes whole over one path, and everything is known before.

    Dynamic programming over the requests in their order: of all ways to have missed m so far, only those are kept that
    no other way beats in both times at which the paths are free again.
    """
    traffic = scenario.traffic
    trace = scenario.trace()
    paths = [Path(trace.path(name), traffic) for name in ("a", "b")]
    size = traffic.request_bytes * OVERHEAD
    fronts: dict[int, list[tuple[float, float]]] = {0: [(0.0, 0.0)]}
    for number in range(scenario.count):
        due = number / traffic.rate_hz
        last = [path.last_use(due, due + traffic.deadline_ms / 1e3) for path in paths]
        ways: dict[int, set[tuple[float, float]]] = {}
        for missed, front in fronts.items():
            for free in front:
                a, b = max(free[0], due), max(free[1], due)
                ways.setdefault(missed + 1, set()).add((a, b))
                if (end := paths[0].end_of(a, size)) <= last[0]:
                    ways.setdefault(missed, set()).add((end, b))
                if (end := paths[1].end_of(b, size)) <= last[1]:
                    ways.setdefault(missed, set()).add((a, end))
        fronts = _not_beaten(ways)
    return min(fronts)


def _not_beaten(ways: dict[int, set[tuple[float, float]]]) -> dict[int, list[tuple[float, float]]]:
    """Keep the ways that no other beats that missed as many or fewer."""
    kept: dict[int, list[tuple[float, float]]] = {}
    best: list[tuple[float, float]] = []
    for missed in sorted(ways):
        best = _front(best + sorted(ways[missed]))
        new = [way for way in best if way in ways[missed]]
        if new:
            kept[missed] = new
    return kept


def _front(ways: list[tuple[float, float]]) -> list[tuple[float, float]]:
    found: list[tuple[float, float]] = []
    for way in sorted(set(ways)):
        if not found or way[1] < found[-1][1]:
            found.append(way)
    return found
