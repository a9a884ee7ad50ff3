"""Engines, a network that goes dark, and a fallback on the robot: every request is answered by its deadline."""

from __future__ import annotations

from collections import Counter
from functools import partial
from typing import TYPE_CHECKING

from lab.simulated.mesh import SERVICE, Mesh, rule
from plr.protos.model.ids import Role, ServiceName
from plr.sidecar.core.robot.fallback.fallbacks import Fallbacks
from plr.sidecar.core.rules.service_rule import FallbackRule
from plr.sidecar.core.seam.application import DeadlineMissed, RequestFailed, ResponseArrived, Unreachable

if TYPE_CHECKING:
    from lab.simulated.mesh import Node
    from plr.sidecar.core.base.values import RequestId
    from plr.sidecar.core.seam.application import ApplicationEvent

DEADLINE_S = 0.5
TAKES_S = 0.08
EVERY_S = 0.1
COUNT = 150


class Robot:
    """What the ROS bridge does with a sidecar's events and its fallback, a server that takes TAKES_S for a request."""

    def __init__(self, mesh: Mesh, node: Node) -> None:
        self.mesh, self.node = mesh, node
        self.outcomes: Counter[tuple[ServiceName, str]] = Counter()
        self.fallbacks = Fallbacks(node.rules, self.outcomes)
        self.fallbacks.set_up(frozenset([SERVICE]), mesh.now)
        self.asked_at: dict[RequestId, float] = {}
        self.took_s: dict[RequestId, float] = {}
        self.network: Counter[str] = Counter()
        """How it ended there: ok, late, or the failure's outcome."""
        self._busy_until = 0.0
        node.server = self.on_event

    def ask(self, payload: bytes) -> None:
        request_id = self.node.submit(payload)
        self.asked_at[request_id] = self.mesh.now
        self.fallbacks.submitted(request_id, SERVICE, payload, self.mesh.now)
        self._act()

    def on_event(self, event: ApplicationEvent) -> None:
        match event:
            case ResponseArrived():
                if not self.fallbacks.has_answered(event.request_id):
                    self._answer(event.request_id)
                self.network["late" if event.late else "ok"] += 1
                self.fallbacks.network_answered(event.request_id, self.mesh.now)
            case RequestFailed():
                self.network[event.outcome] += 1
                assert not self.fallbacks.network_failed(event, self.mesh.now)
            case DeadlineMissed():
                self.fallbacks.deadline_missed(event.request_id, self.mesh.now)
            case Unreachable():
                self.fallbacks.unreachable(event.request_id, self.mesh.now)
        self._act()

    def _answer(self, request_id: RequestId) -> None:
        assert request_id not in self.took_s, "two answers"
        self.took_s[request_id] = self.mesh.now - self.asked_at[request_id]

    def _act(self) -> None:
        for call in self.fallbacks.take_calls():
            self._busy_until = max(self._busy_until, self.mesh.now) + TAKES_S
            self.mesh.at(self._busy_until - self.mesh.now, partial(self._answered, call.request_id))
        assert not self.fallbacks.take_failures()
        due = self.fallbacks.next_timer()
        if due is not None:
            self.mesh.at(max(0.0, due - self.mesh.now), self._on_timer)

    def _on_timer(self) -> None:
        due = self.fallbacks.next_timer()
        if due is not None and due <= self.mesh.now:
            self.fallbacks.handle_timer(self.mesh.now)
            self._act()

    def _answered(self, request_id: RequestId) -> None:
        if self.fallbacks.answered(request_id, self.mesh.now):
            self._answer(request_id)
            self.node.engine.robot.requests.answered_locally(request_id, self.mesh.now)
            self.mesh.pump(self.node)
        self._act()

    def counted(self, outcome: str) -> int:
        return self.outcomes[SERVICE, outcome]


def test_every_request_that_the_network_misses_is_answered_by_the_deadline() -> None:
    mesh = Mesh(seed=5)
    fallback = FallbackRule(ServiceName("/echo_here"))
    node = mesh.add("robot", Role.ROBOT, ["wlan0", "wwan0"], (rule(deadline_s=DEADLINE_S, fallback=fallback),))
    mesh.cloud("cloud-a")
    mesh.cloud("cloud-b")
    mesh.push_views()
    mesh.run(2.0)
    robot = Robot(mesh, node)
    for number in range(COUNT):
        mesh.at(number * EVERY_S, partial(robot.ask, b"%03d" % number + bytes(5_000)))
    for begin, end in ((3.03, 3.5), (6.04, 9.0), (12.0, 12.2)):
        for interface in ("wlan0", "wwan0"):
            for wire in mesh.all_wires_of(f"robot.{interface}"):
                mesh.at(begin, partial(setattr, wire, "cut", True))
                mesh.at(end, partial(setattr, wire, "cut", False))
    mesh.run(COUNT * EVERY_S + 11.0)
    assert len(robot.took_s) == COUNT
    assert max(robot.took_s.values()) <= DEADLINE_S
    missed = COUNT - robot.network["ok"]
    assert 25 <= missed <= robot.counted("won")
    assert robot.counted("started") <= missed + 15, "while it is alive, the network has the work alone"
    assert len(robot.fallbacks) == 0
    assert robot.node.engine.stats.in_flight == 0
