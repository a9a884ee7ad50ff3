"""Fading histograms forget at their half-life and agree with plain ones."""

from __future__ import annotations

import math
import random
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controlplane.core.fading import FadedCount, FadedHistogram, sum_exceeds
from tests.unit.controlplane.samples import histogram

if TYPE_CHECKING:
    from protos.histogram import Histogram

HALF_LIFE_S = 60.0


def faded(plain: Histogram, now: float = 0.0) -> FadedHistogram:
    made = FadedHistogram(HALF_LIFE_S, now)
    made.add(plain, now)
    return made


def test_weight_halves_with_each_half_life() -> None:
    made = faded(histogram(0.01, times=8, lost=8))
    assert made.weight(0.0) == pytest.approx(16)
    assert made.weight(HALF_LIFE_S) == pytest.approx(8)
    assert made.weight(4 * HALF_LIFE_S) == pytest.approx(1)
    made.add(histogram(0.01, times=8), HALF_LIFE_S)
    assert made.weight(HALF_LIFE_S) == pytest.approx(16)
    assert made.lost_share() == pytest.approx(4 / 16)


def test_recent_samples_outweigh_old_ones() -> None:
    made = faded(histogram(0.5, times=100))
    made.add(histogram(0.01, times=100), 3 * HALF_LIFE_S)
    assert made.fraction_over(0.1) == pytest.approx(12.5 / 112.5)
    assert made.median() == pytest.approx(0.01, rel=0.02)


@given(
    st.lists(st.floats(0.0, 100.0), max_size=40),
    st.integers(0, 4),
    st.floats(0.0, 100.0),
)
def test_without_time_passing_it_is_a_plain_histogram(values: list[float], lost: int, limit: float) -> None:
    plain = histogram(*values, lost=lost)
    made = faded(plain)
    assert made.weight(0.0) == pytest.approx(plain.total)
    if plain.total:
        assert made.fraction_over(limit) == pytest.approx(plain.fraction_over(limit))
    else:
        assert math.isnan(made.fraction_over(limit))


def test_counts_fade_and_keep_their_ratio() -> None:
    count = FadedCount(HALF_LIFE_S, 0.0)
    assert math.isnan(count.ratio())
    count.add(10, 2, 0.0)
    assert count.weight(HALF_LIFE_S) == pytest.approx(5)
    assert count.ratio() == pytest.approx(0.2)
    count.add(5, 5, HALF_LIFE_S)
    assert count.ratio() == pytest.approx(6 / 10)


def test_the_sum_of_two_agrees_with_drawing_from_both() -> None:
    rng = random.Random(5)
    first = [rng.lognormvariate(-4.0, 0.6) for _ in range(2000)]
    second = [rng.lognormvariate(-3.5, 0.4) for _ in range(2000)]
    a, b = faded(histogram(*first)), faded(histogram(*second))
    for limit in (0.02, 0.05, 0.08, 0.15, 0.3):
        exact = sum(x + y > limit for x in first[::4] for y in second[::4]) / (500 * 500)
        assert sum_exceeds(a, b, limit) == pytest.approx(exact, abs=0.03)
        doubled = sum(2 * x + y > limit for x in first[::4] for y in second[::4]) / (500 * 500)
        assert sum_exceeds(a, b, limit, times=2.0) == pytest.approx(doubled, abs=0.03)


@given(
    st.lists(st.floats(0.0, 100.0), min_size=1, max_size=20),
    st.lists(st.floats(0.0, 100.0), min_size=1, max_size=20),
    st.floats(-1.0, 200.0),
)
def test_the_sum_is_a_probability_and_no_smaller_than_its_first_part(
    first: list[float], second: list[float], limit: float
) -> None:
    a, b = faded(histogram(*first)), faded(histogram(*second))
    both = sum_exceeds(a, b, limit)
    assert -1e-9 <= both <= 1 + 1e-9
    assert both >= sum_exceeds(a, None, limit) - 1e-9


def test_the_sum_without_samples() -> None:
    empty = FadedHistogram(HALF_LIFE_S, 0.0)
    some = faded(histogram(0.05, times=10))
    assert math.isnan(sum_exceeds(empty, some, 0.1))
    assert sum_exceeds(some, empty, 0.1) == 0.0
    assert sum_exceeds(some, None, 0.01) == 1.0
    assert math.isnan(empty.median())
    assert math.isnan(empty.lost_share())
