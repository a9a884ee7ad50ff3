from __future__ import annotations

import random

import pytest

from plr.sidecar.core.message.repair import FLOOR, MAX_DISPERSION, LossEstimate


def measured(rng: random.Random, share: float, windows: int, *, burst: int = 1, size: int = 130) -> LossEstimate:
    """Windows of `size` datagrams in which bursts of `burst` are lost; `share` of all in the end."""
    estimate = LossEstimate()
    for _ in range(windows):
        missed = sum(burst for _ in range(size) if rng.random() < share / burst)
        estimate.add(size - min(missed, size), min(missed, size))
    return estimate


def test_without_loss_there_is_none() -> None:
    estimate = LossEstimate()
    estimate.add(0, 0)
    assert estimate.loss == (0.0, 1.0)
    estimate.add(10_000, 0)
    assert estimate.loss == (0.0, 1.0)


@pytest.mark.parametrize("share", [0.005, 0.02, 0.05])
@pytest.mark.parametrize("seed", range(5))
def test_independent_losses_are_found_and_not_taken_for_bursts(share: float, seed: int) -> None:
    loss = measured(random.Random(seed), share, 200).loss
    assert 0.7 * share <= loss.share <= 2.5 * share
    assert loss.dispersion < 2.5


@pytest.mark.parametrize("seed", range(5))
def test_bursts_are_told_from_single_losses(seed: int) -> None:
    loss = measured(random.Random(seed), 0.03, 200, burst=8).loss
    assert 3.0 < loss.dispersion <= MAX_DISPERSION


def test_it_rises_within_a_message_and_sinks_slowly() -> None:
    estimate = LossEstimate()
    estimate.add(10_000, 0)
    estimate.add(122, 10)
    assert estimate.loss.share > 0.03
    estimate.add(300, 0)
    assert estimate.loss.share > FLOOR
    estimate.add(20_000, 0)
    assert estimate.loss.share < FLOOR


def test_one_loss_among_the_first_few_is_no_loss_rate() -> None:
    estimate = LossEstimate()
    estimate.add(1, 1)
    assert estimate.loss.share < 0.02
