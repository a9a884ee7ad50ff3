"""How sure it is that a choice is better, beside numeric integration and plain reason."""

from __future__ import annotations

from dataclasses import replace

import pytest
from scipy.integrate import quad
from scipy.stats import beta

from plr.controlplane.core.problem.problem import Block, Objective
from plr.controlplane.core.settle.certainty import probability_better
from tests.unit.controlplane.problems import block


def weighted(epsilon: list[list[float | None]], weights: list[list[float]], **lifts: float) -> Block:
    found = {((0, 0), (1, 1)): lifts["lift"]} if lifts else {}
    return replace(block(epsilon, lifts=found), weights=tuple(tuple(row) for row in weights))


@pytest.mark.parametrize("objective", list(Objective))
@pytest.mark.parametrize(
    ("mean", "weight"), [((0.1, 0.2), (20.0, 20.0)), ((0.5, 0.3), (1.0, 100.0)), ((0.001, 0.003), (50.0, 200.0))]
)
def test_one_path_against_another_is_the_integral(
    objective: Objective, mean: tuple[float, float], weight: tuple[float, float]
) -> None:
    part = weighted([list(mean)], [list(weight)])
    one, other = (beta(m * w, (1 - m) * w) for m, w in zip(mean, weight, strict=True))
    exact, _ = quad(lambda share: one.cdf(other.ppf(share)), 0.0, 1.0)
    assert probability_better(objective, [(part, (0,), (1,))]) == pytest.approx(exact, abs=0.1)


def test_what_is_known_exactly_is_certain() -> None:
    part = block([[0.1, 0.2]])
    assert probability_better(Objective.JOINT, [(part, (0,), (1,))]) == 1.0
    assert probability_better(Objective.JOINT, [(part, (1,), (0,))]) == 0.0
    assert probability_better(Objective.JOINT, [(part, (0,), (0,))]) == 0.5


def test_a_path_that_both_choices_use_makes_neither_less_sure() -> None:
    part = weighted([[0.5, None, None], [None, 0.10, 0.3]], [[1.0, 0.0, 0.0], [0.0, 500.0, 500.0]])
    assert probability_better(Objective.PRODUCT, [(part, (0, 1), (0, 2))]) > 0.99


def test_paths_that_fail_together_are_worse_however_well_known() -> None:
    part = weighted([[0.1, None, None], [None, 0.1, 0.1]], [[200.0] * 3] * 2, lift=8.0)
    assert probability_better(Objective.JOINT, [(part, (0, 2), (0, 1))]) > 0.95
    assert probability_better(Objective.PRODUCT, [(part, (0, 2), (0, 1))]) == pytest.approx(0.5, abs=0.1)


def test_blocks_that_change_together_are_judged_by_their_sum() -> None:
    much, little = weighted([[0.05, 0.5]], [[50.0, 50.0]]), weighted([[0.25, 0.2]], [[50.0, 50.0]])
    assert probability_better(Objective.JOINT, [(little, (0,), (1,))]) < 0.5
    assert probability_better(Objective.JOINT, [(much, (0,), (1,)), (little, (0,), (1,))]) > 0.9
