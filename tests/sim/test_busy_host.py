"""Calls between hosts whose threads get their turn late, over a link that loses datagrams: late turns are no queue."""

from __future__ import annotations

import random
from statistics import median

import pytest

from lab.simulated.mesh import Mesh, Node, rule
from plr.protos.model.ids import Role

MBIT = 1e6 / 8
ONE_WAY_S = 0.025
SIZE = 150_000
RATE_HZ = 10
CALLS = 100
LATE_SHARE = 0.3
"""Of all turns, those that come up to LATE_S late."""
LATE_S = 0.020
PROMPT_S = 0.0003


def elapsed(seed: int, loss: float) -> list[float]:
    mesh = Mesh(seed)
    rules = (rule(deadline_s=0.5),)
    robot = mesh.robot("wlan0", rules=rules)
    cloud = mesh.add("cloud-a", Role.CLOUD, ["eth0"], rules)
    cloud.offers = mesh.cloud("template").offers
    del mesh.nodes["template"]
    cloud.engine.cloud.set_offers(cloud.offers)
    for wire in mesh.both_ways("robot.wlan0", "cloud-a.eth0"):
        wire.delay_s, wire.loss, wire.bytes_per_s = ONE_WAY_S, loss, 100 * MBIT
    make_late(seed, robot, cloud)
    mesh.push_views()
    mesh.run(1.0)
    for _ in range(CALLS):
        mesh.calls += 1
        robot.submit(mesh.calls.to_bytes(4, "big") + bytes(SIZE))
        mesh.run(1 / RATE_HZ)
    mesh.run(5.0)
    return [response.elapsed_s for response in robot.responses()]


def make_late(seed: int, *nodes: Node) -> None:
    rng = random.Random(seed)

    def late_s() -> float:
        return rng.uniform(0, LATE_S) if rng.random() < LATE_SHARE else rng.uniform(0, PROMPT_S)

    for node in nodes:
        node.late_s = late_s


@pytest.mark.parametrize("loss", [0.0, 0.02])
def test_late_turns_beside_losses_do_not_collapse_the_rate(loss: float) -> None:
    """The worst of one run says little: in one of twenty, with any code so far, a call takes more than a second."""
    worst = []
    for seed in range(7):
        times = elapsed(seed, loss)
        assert len(times) == CALLS
        assert median(times) < 0.2
        worst.append(max(times))
    assert median(worst) < 1.0
