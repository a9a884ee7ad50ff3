"""What each redundancy mode costs and misses, over two paths that stall by turns and lose a little."""

from __future__ import annotations

import functools
import random
from dataclasses import dataclass

import pytest

from lab.simulated.mesh import SERVICE, Mesh, Node, Wire, rule
from plr.controlplane.core.estimate.estimator import Estimator
from plr.protos.model.ids import InterfaceName
from plr.protos.model.redundancy_mode import RedundancyMode
from plr.sidecar.core.rules.budget import Budget
from tests.sim.test_mesh import assert_at_most_once, assert_each_answered_once, call_at, mapped

DEADLINE_S = 0.2
SECONDS = 45.0
RATE_HZ = 10.0
SIZE = 3_000
ONE_PATH_EACH = (
    RedundancyMode.SINGLE,
    RedundancyMode.BACKUP,
    RedundancyMode.HEDGE,
    RedundancyMode.ADAPTIVE,
    RedundancyMode.REPLICATE,
)
"""The modes in which one path carries a whole copy, the cheapest first."""


@dataclass(frozen=True)
class Outcome:
    """Of one drive."""

    misses: int
    first_bytes: int
    extra_bytes: int
    """Of copies, as the budgets count them."""
    carried: int
    """Bytes of UDP payload that the robot sent."""

    @property
    def extra(self) -> float:
        return self.extra_bytes / self.first_bytes


def stall(mesh: Mesh, wires: list[Wire], rng: random.Random) -> None:
    """Every five seconds or so, for half a second, each datagram takes 0.4 s longer; the path never goes down."""
    normal_s = wires[0].delay_s

    def set_delay(delay_s: float, next_s: float) -> None:
        for wire in wires:
            wire.delay_s = delay_s
        mesh.at(next_s, lambda: set_delay(normal_s if delay_s > normal_s else 0.4, rng_next(delay_s > normal_s)))

    def rng_next(stalled: bool) -> float:
        return rng.uniform(2.0, 8.0) if stalled else 0.5

    mesh.at(rng.uniform(2.0, 8.0), lambda: set_delay(0.4, 0.5))


@functools.cache
def drive(mode: RedundancyMode, seed: int = 1, budget: Budget | None = None) -> Outcome:
    """The tests share them, as each takes a second of computing."""
    mesh = Mesh(seed)
    mesh.budgets = (budget,) if budget else ()
    robot = mesh.robot("wlan0", "wwan0", rules=(rule(deadline_s=DEADLINE_S, redundancy=mode, exploration=0.01),))
    clouds = mesh.cloud("cloud-a"), mesh.cloud("cloud-b")
    mesh.push_views()
    mesh.run(1.0)
    mapped(mesh, robot, ("wlan0", "cloud-a"), ("wwan0", "cloud-b"))
    rng = random.Random(seed)
    for interface in ("robot.wlan0", "robot.wwan0"):
        wires = mesh.all_wires_of(interface)
        for wire in wires:
            wire.loss, wire.jitter_s = 0.01, 0.004
        stall(mesh, wires, rng)
    before = carried(mesh)
    calls = call_at(mesh, robot, RATE_HZ, SECONDS, size=SIZE)
    mesh.run(9.0)
    assert_each_answered_once(robot, calls)
    assert_at_most_once(*clouds)
    return outcome(mesh, robot, before)


def carried(mesh: Mesh) -> int:
    return sum(wire.carried for (source, _), wire in mesh.wires.items() if source.startswith("robot"))


def outcome(mesh: Mesh, robot: Node, before: int) -> Outcome:
    counted = {"first": 0, "extra": 0}
    for (_, _, kind), size in robot.engine.stats.copy_bytes.items():
        counted[kind] += size
    misses = robot.engine.stats.requests[SERVICE, "deadline_missed"]
    return Outcome(misses, counted["first"], counted["extra"], carried(mesh) - before)


def test_each_mode_misses_less_than_the_cheaper_one() -> None:
    single, backup, hedge, adaptive, replicate = (drive(mode).misses for mode in ONE_PATH_EACH)
    assert single >= 3, "there is something to avoid"
    assert single > backup >= hedge
    assert single - hedge >= 0.9 * (single - replicate)
    assert single > adaptive


def test_hedges_cost_little() -> None:
    single, backup, hedge, adaptive, replicate = (drive(mode) for mode in ONE_PATH_EACH)
    assert single.extra <= 0.02, "exploration only"
    assert backup.extra < hedge.extra < 0.2
    assert replicate.extra == pytest.approx(1.0, abs=0.02), "beside a few sent in trouble"
    assert hedge.carried < 1.2 * single.carried
    assert adaptive.carried < 1.25 * single.carried
    assert replicate.carried > 1.6 * single.carried


@pytest.mark.parametrize(
    ("mode", "spent"), [(RedundancyMode.HEDGE, 0.03), (RedundancyMode.ADAPTIVE, 0.03), (RedundancyMode.REPLICATE, 0.08)]
)
def test_a_budget_is_used_and_never_exceeded(mode: RedundancyMode, spent: float) -> None:
    limited = drive(mode, budget=Budget("w*", extra_load=0.05))
    # Either interface may spend 5 % of all that was answered in time.
    assert spent < limited.extra <= 0.1


@pytest.mark.parametrize("explores", [True, False])
def test_a_pair_that_carries_nothing_is_known_by_exploration_only(explores: bool) -> None:
    """Its server has become slow, which no probe of the path tells."""
    mesh = Mesh(3)
    rules = (rule(redundancy=RedundancyMode.SINGLE, exploration=0.05 if explores else 0.0),)
    robot = mesh.robot("wlan0", "wwan0", rules=rules)
    mesh.cloud("cloud-a")
    slow = mesh.cloud("cloud-b")
    mesh.push_views()
    for wire in mesh.all_wires_of("robot.wwan0"):
        wire.delay_s = 0.02
    mesh.run(1.0)
    mapped(mesh, robot, ("wlan0", "cloud-a"), ("wwan0", "cloud-b"))
    estimator = Estimator(half_life_s=60.0)
    misses = []
    for delay_s in (0.001, 0.15):
        slow.server_delay = lambda delay_s=delay_s: delay_s  # type: ignore[misc]  # mypy infers no type for a default
        call_at(mesh, robot, 10, 45, size=100)
        estimator.merge(robot.name, robot.engine.take_report(mesh.now), mesh.now)
        estimate = estimator.estimate(robot.name, InterfaceName("wwan0"), slow.name, SERVICE, 0.1, mesh.now)
        misses.append(estimate.mean)
    assert len(slow.executed) <= 0.06 * 900
    before, after = misses
    assert before < 0.2
    assert (after > 0.4) == explores
