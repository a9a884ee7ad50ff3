"""Silence counts only while others are heard of, and what it took does not come back."""

from __future__ import annotations

import pytest

from plr.controlplane.core.estimate.fading import FadedHistogram
from plr.controlplane.core.estimate.posterior import Estimate, FadedTrials
from plr.controlplane.core.estimate.staleness import GRACE_S, HALF_LIFE_S, LONGEST_GAP_S, HeardClock, Silence
from tests.support.samples import histogram

STEP_S = 0.5
FOREVER_S = 1e9


def pass_time(clock: HeardClock, start: float, seconds: float) -> float:
    for step in range(1, round(seconds / STEP_S) + 1):
        clock.hear(start + step * STEP_S)
    return start + seconds


def test_without_a_clock_there_is_no_silence() -> None:
    silence = Silence(None)
    assert silence.kept() == silence.end() == 1.0


def test_evidence_halves_while_others_are_heard_of() -> None:
    clock = HeardClock(0.0)
    silence = Silence(clock)
    now = pass_time(clock, 0.0, GRACE_S)
    assert silence.kept() == 1.0
    now = pass_time(clock, now, HALF_LIFE_S)
    assert silence.kept() == pytest.approx(0.5)
    assert silence.end() == pytest.approx(0.5)
    assert silence.kept() == 1.0
    pass_time(clock, now, GRACE_S + 2 * HALF_LIFE_S)
    assert silence.kept() == pytest.approx(0.25)


def test_a_pause_of_all_is_no_silence() -> None:
    clock = HeardClock(0.0)
    silence = Silence(clock)
    clock.hear(1000.0)
    assert LONGEST_GAP_S <= GRACE_S
    assert silence.kept() == 1.0


def test_what_silence_took_does_not_come_back() -> None:
    clock = HeardClock(0.0)
    times, trials = FadedHistogram(FOREVER_S, 0.0, clock), FadedTrials(FOREVER_S, 0.0, clock)
    times.add(histogram(0.5, times=64), 0.0)
    trials.add(64, 64, 0.0)
    now = pass_time(clock, 0.0, GRACE_S + 6 * HALF_LIFE_S)
    assert times.weight(now) == pytest.approx(1.0)
    assert trials.counts(now) == pytest.approx((1.0, 1.0))
    times.add(histogram(0.01, times=3), now)
    trials.add(3, 0, now)
    assert times.weight(now) == pytest.approx(4.0)
    assert times.median() == pytest.approx(0.01, rel=0.02)
    assert trials.posterior(Estimate(0.05, 4.95), now).mean < 0.2
