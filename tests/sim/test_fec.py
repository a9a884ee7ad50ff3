"""What forward error correction saves and costs, over whole cores: 150 kB each way at 10 Hz, 50 ms of round trip."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import median
from typing import TYPE_CHECKING

import pytest

from lab.simulated.mesh import Mesh, Node, rule
from plr.protos.model.ids import Role

if TYPE_CHECKING:
    from collections.abc import Callable

RTT_S = 0.050
SIZE = 150_000
RATE_HZ = 10
WARM_UP_CALLS = 30
"""In which the loss is measured."""
CALLS = 60


@dataclass
class Outcome:
    """What the calls took."""

    elapsed_s: list[float]
    bytes_per_call: float

    def needing_round_trips(self, more_than: float) -> int:
        """Calls that took more round trips than this beyond the one there has to be."""
        return sum(elapsed > RTT_S * (1.0 + more_than) for elapsed in self.elapsed_s)


def pair(
    seed: int, loss: float, fec: float | None, answer: Callable[[bytes], bytes] | None = None
) -> tuple[Mesh, Node]:
    mesh = Mesh(seed)
    robot = mesh.robot("wlan0", rules=(rule(fec=fec),))
    cloud = mesh.add("cloud-a", Role.CLOUD, ["eth0"], (rule(fec=fec),))
    cloud.offers = mesh.cloud("template").offers
    del mesh.nodes["template"]
    cloud.engine.cloud.set_offers(cloud.offers)
    if answer is not None:
        cloud.answer = answer
    for wire in mesh.both_ways("robot.wlan0", "cloud-a.eth0"):
        wire.delay_s, wire.loss = RTT_S / 2, loss
    mesh.push_views()
    mesh.run(1.0)
    return mesh, robot


def call(mesh: Mesh, robot: Node, calls: int, size: int = SIZE) -> Outcome:
    before = len(robot.responses())
    wires = mesh.both_ways("robot.wlan0", "cloud-a.eth0")
    carried = sum(wire.carried for wire in wires)
    for _ in range(calls):
        mesh.calls += 1
        robot.submit(mesh.calls.to_bytes(4, "big") + bytes(size))
        mesh.run(1 / RATE_HZ)
    carried = sum(wire.carried for wire in wires) - carried
    mesh.run(5.0)
    return Outcome([response.elapsed_s for response in robot.responses()[before:]], carried / calls)


def measured(seed: int, loss: float, fec: float | None, size: int = SIZE) -> Outcome:
    mesh, robot = pair(seed, loss, fec)
    call(mesh, robot, WARM_UP_CALLS, size)
    outcome = call(mesh, robot, CALLS, size)
    assert len(outcome.elapsed_s) == CALLS
    return outcome


def test_what_is_added_is_counted() -> None:
    mesh, robot = pair(1, 0.0, 0.1)
    call(mesh, robot, 3)
    (sent,) = (link.stats.datagrams for link in robot.links.values())
    assert sent["sent", "repair"] == pytest.approx(sent["sent", "data"] / 10, rel=0.1)


def test_without_loss_it_costs_nothing() -> None:
    auto, off = (measured(1, 0.0, fec) for fec in (None, 0.0))
    assert auto.bytes_per_call == pytest.approx(off.bytes_per_call, rel=0.001)


@pytest.mark.parametrize("loss", [0.02, 0.05])
@pytest.mark.parametrize("seed", [1, 2])
def test_lost_datagrams_cost_no_round_trip(seed: int, loss: float) -> None:
    auto = measured(seed, loss, None)
    assert auto.needing_round_trips(0.8) <= CALLS // 60
    assert auto.bytes_per_call < 2 * SIZE * (1.25 if loss < 0.03 else 1.4)


def test_retransmission_alone_takes_a_round_trip_more_each_way() -> None:
    off = measured(1, 0.02, 0.0)
    assert off.needing_round_trips(0.8) > CALLS // 2
    assert off.needing_round_trips(3.5) <= CALLS // 10


def test_retransmission_alone_takes_one_round_trip_more_in_99_of_100_calls() -> None:
    """What is sent again, and what ends an exchange, travels twice: losing one copy costs nothing more."""
    late = 0
    for seed in range(3):
        mesh, robot = pair(seed, 0.0, 0.0, answer=lambda payload: payload[:4])
        free = call(mesh, robot, WARM_UP_CALLS)
        for wire in mesh.both_ways("robot.wlan0", "cloud-a.eth0"):
            wire.loss = 0.02
        call(mesh, robot, WARM_UP_CALLS)
        lossy = call(mesh, robot, 130)
        assert len(lossy.elapsed_s) == 130
        usual = median(free.elapsed_s)
        late += sum(elapsed > usual + RTT_S + 0.020 for elapsed in lossy.elapsed_s)
        assert lossy.bytes_per_call < 1.10 * free.bytes_per_call
    assert late <= 3 * 130 // 100


@pytest.mark.parametrize("fec", [None, 0.0])
def test_lone_datagrams_are_doubled_under_loss(fec: float | None) -> None:
    free = measured(3, 0.0, fec, size=1000)
    lossy = measured(3, 0.03, fec, size=1000)
    assert lossy.needing_round_trips(0.8) <= CALLS // 20
    assert 1.5 * free.bytes_per_call < lossy.bytes_per_call < 2.5 * free.bytes_per_call


def test_repairs_alone_cannot_hang_a_message() -> None:
    """A fixed ratio far below the loss: the deficit travels again."""
    outcome = measured(4, 0.10, 0.02)
    assert len(outcome.elapsed_s) == CALLS
