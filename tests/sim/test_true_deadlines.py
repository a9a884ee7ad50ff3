"""What a cloud is told to be left of a request's time is what is left when it arrives, whatever delayed it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.simulated.mesh import Mesh, Node, Wire, rule
from plr.protos.model.ids import Role
from plr.sidecar.core.base.values import Priority
from plr.sidecar.core.path.pmtu import HEADERS_V4
from plr.sidecar.core.seam.application import ExecuteRequest
from plr.sidecar.core.wire.frame import BASE_BYTES
from tests.sim.serial_server import SerialServer

if TYPE_CHECKING:
    from plr.sidecar.core.message.repair import Redundancy
    from plr.sidecar.core.seam.application import ApplicationEvent

MBIT = 1e6 / 8
DEADLINE_S, LIFETIME_S = 0.5, 10.0
CLOSE_S = 0.1
"""Queues come and go faster than the mean round trip follows."""


class Told:
    """A robot with some interfaces and a cloud that notes what each request said when it arrived."""

    def __init__(self, *interfaces: str, fec: Redundancy = None, delay_s: float = 0.025) -> None:
        self.mesh = Mesh(1)
        self.robot: Node = self.mesh.robot(
            *interfaces, rules=(rule(deadline_s=DEADLINE_S, lifetime_s=LIFETIME_S, fec=fec),)
        )
        self.cloud = self.mesh.cloud("cloud-a")
        self.cloud.server = self._note
        self.submitted: dict[int, float] = {}
        self.seen: list[tuple[int, float, float]] = []
        """Of each request that arrived: its number, by how much the deadline and the lifetime told were too late."""
        self.mesh.push_views()
        self.wires: list[Wire] = []
        for interface in interfaces:
            self.wires += self.mesh.both_ways(f"robot.{interface}", "cloud-a.eth0")
        for wire in self.wires:
            wire.delay_s = delay_s
        self.mesh.run(1.0)

    def _note(self, event: ApplicationEvent) -> None:
        if not isinstance(event, ExecuteRequest):
            return
        now, number = self.mesh.now, int.from_bytes(bytes(event.payload[:4]), "big")
        left_s = self.submitted[number] + DEADLINE_S - now
        lifetime_left_s = self.submitted[number] + LIFETIME_S - now
        self.seen.append((number, event.deadline_s - max(left_s, 0.0), event.expires_s - lifetime_left_s))

        def answer() -> None:
            self.cloud.engine.cloud.complete(event.execution, bytes(event.payload[:4]), 0.001, self.mesh.now)
            self.mesh.pump(self.cloud)

        self.mesh.at(0.001, answer)

    def ask(self, size: int, requests: int = 1, every_s: float = 0.0) -> None:
        for _ in range(requests):
            number = len(self.submitted)
            self.submitted[number] = self.mesh.now
            self.robot.submit(number.to_bytes(4, "big") + bytes(size))
            self.mesh.run(every_s)

    def assert_true(self, least: int) -> None:
        assert len(self.seen) >= least
        for number, deadline_off_s, lifetime_off_s in self.seen:
            assert abs(deadline_off_s) <= CLOSE_S, number
            assert abs(lifetime_off_s) <= CLOSE_S, number


@pytest.mark.audit("dp-5")
@pytest.mark.parametrize("fec", [None, 0.5])
@pytest.mark.parametrize(("size", "hz"), [(120_000, 10), (60_000, 5)])
def test_what_waited_to_be_sent_says_so(size: int, hz: int, fec: Redundancy) -> None:
    """More than the path carries: requests wait in the robot for up to their lifetime."""
    told = Told("wlan0", fec=fec)
    for wire in told.wires:
        wire.bytes_per_s = 2 * MBIT
    told.ask(size, requests=6 * hz, every_s=1 / hz)
    told.mesh.run(12.0)
    told.assert_true(least=20)


@pytest.mark.audit("dp-5")
@pytest.mark.parametrize("size", [100, 20_000])
@pytest.mark.parametrize("fec", [0.0, 0.5])
@pytest.mark.parametrize("outage_s", [0.3, 3.0])
def test_what_is_sent_again_after_an_outage_says_what_is_left_by_then(size: int, fec: float, outage_s: float) -> None:
    told = Told("wlan0", fec=fec)
    told.ask(1000, requests=20, every_s=0.05)
    for wire in told.wires:
        wire.cut = True
    told.ask(size, requests=5, every_s=0.001)
    told.mesh.run(outage_s)
    for wire in told.wires:
        wire.cut = False
    told.mesh.run(3.0)
    told.assert_true(least=25)


@pytest.mark.audit("dp-5")
def test_what_lost_its_first_symbol_says_what_is_left_when_it_is_whole() -> None:
    told = Told("wlan0", fec=0.0)
    for wire in told.wires:
        wire.loss = 0.2
    told.ask(30_000, requests=50, every_s=0.1)
    told.mesh.run(5.0)
    told.assert_true(least=45)


@pytest.mark.audit("dp-5")
def test_copies_over_several_paths_say_the_same() -> None:
    told = Told("wlan0", "wwan0")
    for wire, rate in zip(told.wires, (1, 1, 3, 3), strict=True):
        wire.bytes_per_s = rate * MBIT
    told.ask(60_000, requests=60, every_s=0.1)
    told.mesh.run(12.0)
    told.assert_true(least=40)


@pytest.mark.audit("dp-5")
def test_what_is_cut_again_into_smaller_symbols_says_what_is_left_by_then() -> None:
    told = Told("wlan0", "wwan0")
    told.mesh.run(20.0)  # both paths carry more than the least by now
    narrow = told.mesh.all_wires_of("robot.wwan0")
    for wire in narrow:
        wire.mtu = BASE_BYTES + HEADERS_V4
    for wire in told.mesh.all_wires_of("robot.wlan0"):
        wire.bytes_per_s = 0.2 * MBIT
    told.ask(40_000, requests=3, every_s=0.01)
    told.mesh.run(0.2)
    for wire in told.mesh.all_wires_of("robot.wlan0"):
        wire.cut = True
    told.mesh.run(9.0)
    told.assert_true(least=2)


@pytest.mark.audit("dp-5")
def test_a_queue_in_the_network_is_known_by_the_round_trip() -> None:
    """Half of the round trip counts as gone: where the way there is the slower one, the rest of it does not."""
    told = Told("wlan0", delay_s=0.4)
    told.ask(1000, requests=50, every_s=0.1)
    told.mesh.run(2.0)
    told.seen = told.seen[5:]
    told.assert_true(least=40)


@pytest.mark.audit("dp-5")
def test_what_is_past_its_lifetime_does_not_run() -> None:
    told = Told("wlan0")
    told.mesh.wire("robot.wlan0", "cloud-a.eth0").delay_s = LIFETIME_S
    told.mesh.wire("cloud-a.eth0", "robot.wlan0").delay_s = LIFETIME_S
    for link in told.robot.links.values():
        for path in link._paths.values():
            path.recovery.rtt.smoothed = 2 * LIFETIME_S
    told.ask(100)
    told.mesh.run(2 * LIFETIME_S)
    assert not told.seen
    assert told.cloud.engine.stats.dropped["request_expired"] > 0


def shared_server(
    busy_s: float, size: int, robot_a: Priority = Priority.NORMAL, rate: float = 2 * MBIT
) -> tuple[list[float | None], SerialServer]:
    """Two robots at 10 Hz share a server: A over a slow path, B with small requests; what became of B's.

    Returns B's latencies, None for what was not answered.
    """
    mesh, deadline_s = Mesh(1), 0.4
    of_b = rule(deadline_s=deadline_s, lifetime_s=10.0)
    a = mesh.add("robota", Role.ROBOT, ["wlan0"], (rule(deadline_s=deadline_s, lifetime_s=10.0, priority=robot_a),))
    b = mesh.add("robotb", Role.ROBOT, ["wlan0"], (of_b,))
    cloud = mesh.cloud("cloud-a")
    server = SerialServer(mesh, cloud, busy_s)
    mesh.push_views()
    for wire in mesh.both_ways("robota.wlan0", "cloud-a.eth0"):
        wire.delay_s, wire.bytes_per_s = 0.025, rate
    mesh.run(1.0)
    ids = []
    for call in range(200):
        a.submit(b"A" + call.to_bytes(4, "big") + bytes(size))
        ids.append(b.submit(b"B" + call.to_bytes(4, "big") + bytes(500)))
        mesh.run(0.1)
    mesh.run(12.0)
    took = {event.request_id: event.elapsed_s for event in b.responses()}
    return [took.get(request) for request in ids], server


def missed(latencies: list[float | None]) -> int:
    return sum(latency is None or latency > 0.4 for latency in latencies)


@pytest.mark.audit("dp-4")
@pytest.mark.parametrize(("busy_s", "ran"), [(0.05, 390), (0.09, 300)])
def test_bulk_at_an_overloaded_server_costs_what_is_more_urgent_nothing(busy_s: float, ran: int) -> None:
    latencies, server = shared_server(busy_s, 1000, robot_a=Priority.LOW, rate=100 * MBIT)
    assert missed(latencies) == 0
    assert server.ran >= ran, "and the server does the same work"


@pytest.mark.audit("dp-4")
@pytest.mark.parametrize(("busy_s", "size"), [(0.07, 40_000), (0.08, 40_000), (0.09, 120_000)])
def test_what_comes_late_over_a_slow_path_does_not_make_others_late(busy_s: float, size: int) -> None:
    """What is late, or would be when it is done, does not run before what can still be in time."""
    latencies, _ = shared_server(busy_s, size)
    assert missed(latencies) == 0
