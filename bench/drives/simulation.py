"""Sends requests over two paths whose rates change as a scenario's trace says, in simulated time, with the real cores.

Links are first in, first out, as those of `bench.evaluation.ideal`. Only the rates, delays and losses of the trace
disturb anybody.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass
from itertools import count
from typing import TYPE_CHECKING

from bench.evaluation.outcome import UNANSWERED_S, Outcome, Request
from lab.simulated.mesh import IPV6, SERVICE, Mesh, Node, rule
from plr.controlplane.planning.fifo import FifoLink
from plr.protos.model.ids import InterfaceName, NodeName, Version
from plr.protos.model.mapping import Assignment, MappingSet, ServiceMapping

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bench.evaluation.scenario import Scenario
    from plr.protos.model.ids import Address
    from plr.protos.model.redundancy_mode import RedundancyMode
    from plr.sidecar.core.base.values import RequestId
    from plr.sidecar.core.rules.budget import Budget

STARTING_S = 1.0
WARM_S = 4.0
"""Of requests over a good network before the window."""
WARM_BYTES_PER_S, WARM_DELAY_S = 6.25e6, 0.02
IP_HEADERS = 28
PATHS = ("a", "b")
CLOUDS = ("cloud-a", "cloud-b")


@dataclass(frozen=True, slots=True)
class Copies:
    """Bytes of copies, as budgets count them; the warm-up included."""

    first: int
    extra: int


class DatagramLink(FifoLink):
    """One direction of a path: what is lost stays lost."""

    sent = 0

    def carry(self, at: float, size: int, rng: random.Random) -> float:
        """Return when a datagram of this many bytes, headers included, has arrived; inf: never."""
        self.sent += size
        arrives = self.send(at, size, rng)
        loss = self._losses[self._step(at)]
        return math.inf if loss and rng.random() < loss else arrives

    def _lost(self, at: float, packets: int, rng: random.Random) -> int:
        return 0


class DriveMesh(Mesh):
    """A mesh whose robot has interface a behind path a of the trace and b behind b, whichever cloud is at the end."""

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(seed=1)
        self.dual_stack = True  # as the hosts of the lab
        trace = scenario.trace()
        self.begins = self.now + STARTING_S + WARM_S
        self.losses = random.Random(1)
        self.links = {(name, up): DatagramLink(trace.path(name), up=up) for name in PATHS for up in (True, False)}
        self._warm_busy_until = dict.fromkeys(self.links, 0.0)

    def _carry(self, source: Address, destination: Address, data: bytes) -> None:
        up = source[0].startswith("robot.")
        name = (source if up else destination)[0].removesuffix(IPV6).rsplit(".", 1)[1]
        if self.now < self.begins:
            left = max(self.now, self._warm_busy_until[name, up]) + len(data) / WARM_BYTES_PER_S
            self._warm_busy_until[name, up] = left
            arrives = left + WARM_DELAY_S
        else:
            link = self.links[name, up]
            arrives = self.begins + link.carry(self.now - self.begins, len(data) + IP_HEADERS, self.losses)
        if math.isfinite(arrives):
            self.at(arrives - self.now, lambda: self._arrive(source, destination, data))


@dataclass(frozen=True, slots=True)
class Drive:
    """One run: what became of its requests, and what its copies weighed."""

    outcome: Outcome
    copies: Copies

    @property
    def misses(self) -> int:
        """Number of requests that missed the deadline."""
        return round(self.outcome.figures().misses)

    @property
    def sent(self) -> int:
        """Bytes of IP packets that the robot sent in the window."""
        return sum(self.outcome.bytes_sent.values())


def drive(
    scenario: Scenario, mode: RedundancyMode, paths: Sequence[str] = PATHS, budget: Budget | None = None
) -> Drive:
    """Send the scenario's requests over these of its paths."""
    traffic = scenario.traffic
    mesh = DriveMesh(scenario)
    mesh.budgets = (budget,) if budget else ()
    service = rule(deadline_s=traffic.deadline_ms / 1e3, redundancy=mode, exploration=0.01, lifetime_s=UNANSWERED_S)
    robot = mesh.robot(*paths, rules=(service,))
    for name in CLOUDS:
        _answer_one_at_a_time(mesh, mesh.cloud(name), traffic.compute_ms / 1e3, traffic.answer_bytes)
    mesh.push_views()
    mesh.run(STARTING_S)
    _map(mesh, robot, zip(paths, CLOUDS, strict=False))
    numbers = count(1)
    _call(mesh, robot, int(WARM_S * traffic.rate_hz), scenario, numbers)
    mesh.now = mesh.begins
    asked = _call(mesh, robot, scenario.count, scenario, numbers)
    sent = {name: mesh.links[name, True].sent for name in paths}
    mesh.run(UNANSWERED_S)
    answers = {event.request_id: event for event in robot.responses()}
    requests = [
        Request(due_s, due_s, due_s + answers[request_id].elapsed_s if request_id in answers else None)
        for request_id, due_s in asked.items()
    ]
    copies = {"first": 0, "extra": 0}
    for (_, _, kind), size in robot.engine.stats.copy_bytes.items():
        copies[kind] += size
    contender = f"plr-{mode.value}" if len(paths) > 1 else f"plr-{mode.value}-{paths[0]}"
    outcome = Outcome(scenario.name, scenario.case, contender, traffic.deadline_ms, tuple(requests), sent)
    return Drive(outcome, Copies(**copies))


def _map(mesh: Mesh, robot: Node, pairs: zip[tuple[str, str]]) -> None:
    assignments = tuple(Assignment(InterfaceName(interface), NodeName(server)) for interface, server in pairs)
    mesh.push_mapping(robot, MappingSet(Version(1), 1, (ServiceMapping(SERVICE, assignments),)))


def _answer_one_at_a_time(mesh: Mesh, cloud: Node, compute_s: float, size: int) -> None:
    free_at = mesh.now

    def delay() -> float:
        nonlocal free_at
        free_at = max(free_at, mesh.now) + compute_s
        return free_at - mesh.now

    cloud.server_delay = delay
    cloud.answer = lambda request: request[:16] + bytes(size)


def _call(mesh: DriveMesh, robot: Node, calls: int, scenario: Scenario, numbers: count[int]) -> dict[RequestId, float]:
    """Send the requests; return when each was due, from the start of the window."""
    asked: dict[RequestId, float] = {}
    for _ in range(calls):
        due_s = mesh.now - mesh.begins
        asked[robot.submit(next(numbers).to_bytes(4, "big") + bytes(scenario.traffic.request_bytes))] = due_s
        mesh.run(1 / scenario.traffic.rate_hz)
    return asked
