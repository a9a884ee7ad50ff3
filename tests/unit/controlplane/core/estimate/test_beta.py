"""Quantiles of Beta distributions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.stats import beta

from plr.controlplane.core.estimate.beta import interval_steps, intervals, quantiles
from plr.controlplane.core.estimate.posterior import Estimate

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.mark.parametrize("share", [0.05, 0.5, 0.95])
def test_they_are_those_of_scipy(share: float) -> None:
    rng = np.random.default_rng(7)
    a, b = 10 ** rng.uniform(-3, 3.5, 500), 10 ** rng.uniform(-2, 4, 500)
    assert quantiles(a, b, share) == pytest.approx(beta.ppf(share, a, b), abs=1e-11)


def test_an_interval_holds_what_it_says() -> None:
    estimates = [Estimate(0.5, 0.5), Estimate(30.0, 970.0)]
    for estimate, (low, high) in zip(estimates, intervals(estimates, 0.9), strict=True):
        inside = beta.cdf(high, estimate.misses, estimate.hits) - beta.cdf(low, estimate.misses, estimate.hits)
        assert inside == pytest.approx(0.9)
        assert low < estimate.mean < high


def test_many_intervals_take_many_steps() -> None:
    rng = np.random.default_rng(7)
    estimates = [Estimate(*(10 ** rng.uniform(-2, 3, 2))) for _ in range(500)]
    found: list[list[tuple[float, float]]] = []

    def steps() -> Iterator[None]:
        found.append((yield from interval_steps(estimates, 0.9)))

    assert len(list(steps())) > 20
    assert found == [intervals(estimates, 0.9)]


def test_of_none_there_are_none() -> None:
    assert intervals([], 0.9) == []


@pytest.mark.parametrize("misses", [0.003, 0.01, 0.02, 0.03])
def test_an_interval_next_to_0_is_none_upside_down(misses: float) -> None:
    ((low, high),) = intervals([Estimate(misses, 60.0)], 0.9)
    assert 0.0 <= low <= high


@pytest.mark.parametrize("trials", [30.0, 3000.0])
def test_trials_without_a_miss_leave_three_over_their_number(trials: float) -> None:
    ((low, high),) = intervals([Estimate(1e-6, trials)], 0.9)
    assert low < 1e-9
    assert high == pytest.approx(3.0 / trials, rel=0.1)
    ((low, high),) = intervals([Estimate(trials, 1e-6)], 0.9)
    assert 1.0 - low == pytest.approx(3.0 / trials, rel=0.1)
    assert high > 1.0 - 1e-9
