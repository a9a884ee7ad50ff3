"""The assignment problem proper equals SciPy's answer."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from plr.controlplane.core.solve.matching import cheapest_columns, cheapest_matching


@pytest.mark.parametrize("seed", range(5))
def test_equals_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(200):
        rows = int(rng.integers(1, 9))
        costs = rng.random((rows, int(rng.integers(rows, 14)))) * 10 - 5
        if rng.random() < 0.3:
            costs = np.round(costs)
        columns = cheapest_columns(costs)
        assert len(set(columns)) == rows
        best = costs[linear_sum_assignment(costs)].sum()
        assert costs[np.arange(rows), columns].sum() == pytest.approx(best)


def test_slots_are_filled_before_anything_is_exceeded() -> None:
    costs = np.array([[0.0, 9.0], [0.0, 9.0], [0.0, 9.0]])
    assert sorted(cheapest_matching(costs, 1, 1e6)) == [0, 0, 1]
    assert sorted(cheapest_matching(costs, 2, 1e6)) == [0, 0, 1]
    assert sorted(cheapest_matching(costs, 3, 1e6)) == [0, 0, 0]
    assert sorted(cheapest_matching(costs, 1, 1.0)) == [0, 0, 0]


def test_a_missing_path_is_not_taken() -> None:
    assert cheapest_matching(np.array([[np.inf, 1.0], [0.0, 0.5]]), 1, 1e6) == [1, 0]
