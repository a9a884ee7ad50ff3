"""Fading histograms forget at their half-life and agree with plain ones."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest

from plr.controlplane.core.estimate.fading import FadedCount, FadedHistogram, FadedShares
from plr.protos.base.histogram import MAX_COUNT, Histogram
from plr.protos.base.size_class import SIZE_CLASSES
from plr.protos.model.explanation import SAMPLE
from tests.support.samples import histogram

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


@pytest.mark.audit("ops-20")
def test_however_many_samples_are_claimed_they_can_be_reported() -> None:
    most = Histogram.from_sparse([20, 40], [MAX_COUNT // 4, 3 * MAX_COUNT // 4], 0)
    made = faded(most)
    for _ in range(1000):
        made.add(most, 1.0)
    together = Histogram()
    for _ in range(SIZE_CLASSES):
        together.merge(made.scaled(1.0, SAMPLE))
    told = Histogram.from_sparse(*together.to_sparse())
    assert told.sparse[1][1] / told.total == pytest.approx(0.75)
    assert faded(histogram(0.01, times=8)).scaled(0.0, SAMPLE).total == 8 * SAMPLE


def test_recent_samples_outweigh_old_ones() -> None:
    made = faded(histogram(0.5, times=100))
    made.add(histogram(0.01, times=100), 3 * HALF_LIFE_S)
    found = made.distribution()
    assert found is not None
    assert found.over(np.array([0.1]))[0] == pytest.approx(12.5 / 112.5)
    assert made.median() == pytest.approx(0.01, rel=0.02)


def test_kinds_fade_and_rare_ones_are_left_out() -> None:
    made = FadedShares(3, HALF_LIFE_S, 0.0)
    assert list(made.shares(0.1)) == []
    made.add(0, 8, 0.0)
    made.add(2, 4, HALF_LIFE_S)
    assert list(made.shares(0.1)) == [(0, 0.5), (2, 0.5)]
    made.add(2, 60, HALF_LIFE_S)
    assert list(made.shares(0.1)) == [(2, 1.0)]


def test_counts_fade_and_keep_their_ratio() -> None:
    count = FadedCount(HALF_LIFE_S, 0.0)
    assert math.isnan(count.ratio())
    count.add(10, 2, 0.0)
    assert count.weight(HALF_LIFE_S) == pytest.approx(5)
    assert count.ratio() == pytest.approx(0.2)
    count.add(5, 5, HALF_LIFE_S)
    assert count.ratio() == pytest.approx(6 / 10)


def test_what_was_called_off_counts_for_as_long_as_it_lasted() -> None:
    """Of 1000 with known times, those slower than 0.1 s are called off then, in nine of ten cases."""
    rng = random.Random(7)
    true = [rng.lognormvariate(-2.7, 0.8) for _ in range(4000)]
    known, ended = Histogram(), Histogram()
    for value in true:
        if value > 0.1 and rng.random() < 0.9:
            ended.record(0.1)
        else:
            known.record(value)
    made = FadedHistogram(HALF_LIFE_S, 0.0)
    made.add(known, 0.0, ended)
    found = made.distribution()
    assert found is not None
    for limit in (0.05, 0.09, 0.15, 0.3):
        exact = sum(value > limit for value in true) / len(true)
        assert found.over(np.array([limit]))[0] == pytest.approx(exact, abs=0.04)
    assert made.weight(0.0) == len(true)
    assert found.tail[0] == pytest.approx(1.0)


def test_what_was_only_called_off_may_never_come() -> None:
    made = FadedHistogram(HALF_LIFE_S, 0.0)
    made.add(histogram(0.01, times=3), 0.0, histogram(0.1, times=1))
    found = made.distribution()
    assert found is not None
    assert found.never == pytest.approx(0.25)
    assert found.median() == pytest.approx(0.01, rel=0.02)
    made.add(histogram(), 20 * HALF_LIFE_S, histogram(0.1, times=1))
    later = made.distribution()
    assert later is not None
    assert later.median() == math.inf


def test_after_very_long_nothing_is_known() -> None:
    made = faded(histogram(0.01, times=8, lost=1))
    made.add(histogram(), 1060 * HALF_LIFE_S)
    assert made.distribution() is None
    assert made.answered() is None
    assert math.isnan(made.lost_share())
    assert math.isnan(made.median())
