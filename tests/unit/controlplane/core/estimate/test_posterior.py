"""What trials are worth: independent ones in full, streaks of misses less."""

from __future__ import annotations

import random

import pytest

from plr.controlplane.core.estimate.posterior import BATCH_S, Estimate, FadedTrials

PRIOR = Estimate(0.5, 0.5)
STEP_S = 0.5


def fed(outcomes: list[bool], *, each_report: int = 5, half_life_s: float = 1e6) -> tuple[FadedTrials, float]:
    trials = FadedTrials(half_life_s, 0.0)
    now = 0.0
    for start in range(0, len(outcomes), each_report):
        report = outcomes[start : start + each_report]
        now += STEP_S
        trials.add(len(report), sum(report), now)
    return trials, now


def streaks(rng: random.Random, total: int, length: int) -> list[bool]:
    found: list[bool] = []
    while len(found) < total:
        found += [rng.random() < 0.2] * length
    return found[:total]


def test_mean_and_weight_of_an_estimate() -> None:
    estimate = Estimate.of(0.2, 10.0)
    assert (estimate.misses, estimate.hits) == pytest.approx((2.0, 8.0))
    assert (estimate.mean, estimate.weight) == pytest.approx((0.2, 10.0))


def test_independent_misses_are_worth_what_they_count() -> None:
    trials, now = fed(streaks(random.Random(1), 20_000, 1))
    assert trials.design_effect() == pytest.approx(1.0, abs=0.25)
    posterior = trials.posterior(PRIOR, now)
    assert posterior.mean == pytest.approx(0.2, abs=0.01)
    assert posterior.weight > 15_000


@pytest.mark.parametrize("length", [20, 100, 400])
def test_streaks_are_worth_about_as_many_as_there_are_streaks(length: int) -> None:
    trials, now = fed(streaks(random.Random(length), 60_000, length))
    # A run of equal outcomes tells once; the correlation beyond neighbouring batches is only guessed at.
    assert 0.4 * length < trials.design_effect() < 2.5 * length
    assert trials.posterior(PRIOR, now).mean == pytest.approx(0.2, abs=0.06)


def test_few_trials_take_the_usual_streaks_for_granted() -> None:
    trials, now = fed([False] * 10)
    assert now < BATCH_S
    assert trials.posterior(PRIOR, now).weight == pytest.approx(1.0 + 10 / 5)
    assert FadedTrials(60.0, 0.0).posterior(PRIOR, 0.0) == PRIOR


def test_trials_fade_and_the_prior_comes_back() -> None:
    trials, now = fed([True] * 1000, half_life_s=10.0)
    fresh, faded = trials.posterior(PRIOR, now), trials.posterior(PRIOR, now + 10.0)
    assert fresh.mean > faded.mean
    assert fresh.weight > faded.weight > 1.0
    assert trials.posterior(PRIOR, now + 1000.0).mean == pytest.approx(0.5)


def test_a_steady_miss_ratio_has_no_design_effect_below_one() -> None:
    trials, _ = fed([False, True] * 5000, each_report=10)
    assert trials.design_effect() == 1.0


def test_a_path_that_dies_is_noticed_within_seconds_and_a_steady_one_is_known_well() -> None:
    steady = [number % 10 == 0 for number in range(2000)]
    trials, now = fed(steady, half_life_s=60.0)
    assert trials.posterior(PRIOR, now).mean == pytest.approx(0.1, abs=0.02)
    for _ in range(10):
        now += STEP_S
        trials.add(5, 5, now)
    assert trials.posterior(PRIOR, now).mean > 0.5, "five seconds after a steady 0.1"
    for _ in range(20):
        now += STEP_S
        trials.add(5, 0, now)
    assert trials.posterior(PRIOR, now).mean < 0.2, "and its return as well"


def test_one_early_miss_does_not_condemn() -> None:
    trials, now = fed([True, False, False, False, False], half_life_s=60.0)
    prior = Estimate.of(0.01, 20.0)
    assert trials.posterior(prior, now).mean < 0.1


@pytest.mark.parametrize("claimed", [2**53, 2**63 - 1])
def test_a_member_that_claims_any_number_leaves_a_distribution(claimed: int) -> None:
    """A posterior without any hit left has none, and planning failed for the whole fleet."""
    trials = FadedTrials(60.0, 0.0)
    for second in range(100):
        trials.add(claimed, claimed, float(second))
    estimate = trials.posterior(PRIOR, 100.0)
    assert 0.0 < estimate.mean < 1.0


def test_an_estimate_has_some_weight_on_either_side() -> None:
    for mean in (0.0, 1.0):
        estimate = Estimate.of(mean, 1e9)
        assert estimate.mean == pytest.approx(mean, abs=1e-9)
        assert min(estimate.misses, estimate.hits) > 0.0
