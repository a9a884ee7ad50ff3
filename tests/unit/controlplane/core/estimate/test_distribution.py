"""Distributions agree with plain histograms, and sums of two with drawing from both."""

from __future__ import annotations

import random

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from plr.controlplane.core.estimate.distribution import Distribution
from plr.controlplane.core.estimate.fading import FadedHistogram
from tests.support.samples import histogram

values = st.lists(st.floats(0.0, 100.0), min_size=1, max_size=20)


def of(*seconds: float, lost: int = 0) -> Distribution:
    made = FadedHistogram(60.0, 0.0)
    made.add(histogram(*seconds, lost=lost), 0.0)
    found = made.distribution()
    assert found is not None
    return found


@given(values, st.integers(0, 4), st.floats(0.0, 100.0))
@example([0.0] * 11 + [1.0, 1.0, 2.0, 2.0, 3.0, 3.0, 3.0, 3.0, 4.0], 2, 0.0).via("half, but for rounding")
def test_it_is_what_a_plain_histogram_says(seconds: list[float], lost: int, limit: float) -> None:
    made = of(*seconds, lost=lost)
    plain = histogram(*seconds, lost=lost)
    assert made.over(np.array([limit]))[0] == pytest.approx(plain.fraction_over(limit))
    assert made.sum_exceeds(None, limit) == pytest.approx(plain.fraction_over(limit))
    assert made.median() == pytest.approx(plain.quantile(0.5))
    assert made.never == pytest.approx(lost / plain.total)


def test_the_sum_of_two_agrees_with_drawing_from_both() -> None:
    rng = random.Random(5)
    first = [rng.lognormvariate(-4.0, 0.6) for _ in range(2000)]
    second = [rng.lognormvariate(-3.5, 0.4) for _ in range(2000)]
    a, b = of(*first, lost=100), of(*second, lost=50)
    answered = 2000 / 2100 * 2000 / 2050
    for limit in (0.02, 0.05, 0.08, 0.15, 0.3):
        slow = sum(x + y > limit for x in first[::4] for y in second[::4]) / (500 * 500)
        assert a.sum_exceeds(b, limit) == pytest.approx(answered * slow + 1.0 - answered, abs=0.03)


@given(values, values, st.floats(-1.0, 200.0))
def test_the_sum_is_a_probability_and_falls_as_the_limit_grows(
    first: list[float], second: list[float], limit: float
) -> None:
    a, b = of(*first), of(*second, lost=1)
    both = a.sum_exceeds(b, limit)
    assert -1e-9 <= both <= 1 + 1e-9
    assert both >= b.never - 1e-9
    assert both >= a.sum_exceeds(b, limit + 1.0) - 1e-9


def test_a_mixture_lies_between() -> None:
    mixed = Distribution.mixed(of(0.01), 0.75, of(1.0, lost=1))
    assert mixed.over(np.array([0.1]))[0] == pytest.approx(0.25)
    assert mixed.never == pytest.approx(0.125)
