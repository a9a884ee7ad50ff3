"""What choices cost under each objective."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest

from plr.controlplane.core.problem.objectives import joint_miss, objective_cost, objective_costs
from plr.controlplane.core.problem.problem import Objective
from tests.unit.controlplane.problems import block, plain_objective, random_problem, valid_choices

TOGETHER = ((0, 0), (1, 1))


@pytest.mark.parametrize("lift", [0.0, 0.5, 1.0, 5.0])
def test_two_paths_miss_together_as_often_as_their_lift_says(lift: float) -> None:
    part = block([[0.1, 0.5], [0.5, 0.2]], lifts={TOGETHER: lift})
    assert joint_miss(part, (0, 1)) == pytest.approx(0.1 * 0.2 * lift, abs=1e-9)
    assert joint_miss(part, (1, 0)) == pytest.approx(0.25)


def test_no_set_misses_more_often_than_one_path_or_pair_of_it() -> None:
    two = block([[0.1, 0.5], [0.5, 0.2]], lifts={TOGETHER: 1000.0})
    assert joint_miss(two, (0, 1)) == pytest.approx(0.1)
    three = block(
        [[0.1], [0.1], [0.1]], lifts={((0, 0), (1, 0)): 10.0, ((0, 0), (2, 0)): 10.0, ((1, 0), (2, 0)): 6.0}, capacity=0
    )
    assert joint_miss(three, (0, 0, 0)) == pytest.approx(0.06)


def test_an_interface_without_a_server_adds_nothing_to_a_product() -> None:
    part = block([[0.1, None], [0.2, 0.3]], idempotent=False, lifts={((0, 0), (1, 1)): 7.0})
    assert joint_miss(part, (None, 1)) == pytest.approx(0.3)
    assert objective_cost(Objective.PRODUCT, part, (None, 1)) == pytest.approx(math.log(0.3))
    assert objective_cost(Objective.SUM, part, (None, 1)) == pytest.approx(1.3)


@pytest.mark.parametrize("objective", Objective)
def test_costs_follow_the_definition_one_by_one_and_all_at_once(objective: Objective) -> None:
    rng = random.Random(31)
    for _ in range(200):
        for part in random_problem(rng, objective).blocks:
            choices = list(valid_choices(part))
            plain = [plain_objective(objective, part, choice) for choice in choices]
            assert [objective_cost(objective, part, choice) for choice in choices] == pytest.approx(plain)
            table = np.array([[-1 if server is None else server for server in choice] for choice in choices])
            assert objective_costs(objective, part, table) == pytest.approx(np.array(plain))
