"""The random fleets of the matcher's measurement, and the flow that its plans are held against."""

from __future__ import annotations

import pytest

from bench.matcher.fleets import flow_optimum, random_fleet
from plr.controlplane.solver.matcher import solve
from tests.unit.controlplane.problems import best_price


@pytest.mark.parametrize("seed", range(5))
def test_the_flow_finds_the_best_of_all_plans(seed: int) -> None:
    problem = random_fleet(3, 2, 3, seed=seed)
    best = best_price(problem)
    assert best.excess == 0
    assert flow_optimum(problem) == pytest.approx(best.cost, abs=1e-5)


def test_the_flow_is_no_worse_than_a_plan_and_no_better_than_its_bound() -> None:
    problem = random_fleet(70, 3, 8, seed=1)
    plan = solve(problem, time_limit_s=60.0)
    assert plan.bound - 1e-3 <= flow_optimum(problem) <= plan.cost + 1e-3


def test_with_lifts_every_pair_of_paths_over_two_interfaces_has_one() -> None:
    (block,) = random_fleet(1, 3, 4, seed=1, lifts=True).blocks
    assert len(block.lifts) == 3 * 4 * 4
    assert all(one[0] < two[0] for one, two in block.lifts)
    assert not random_fleet(1, 3, 4, seed=1).blocks[0].lifts
