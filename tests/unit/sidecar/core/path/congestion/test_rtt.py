from __future__ import annotations

import pytest

from plr.sidecar.core.path.congestion.rtt import (
    GRANULARITY_S,
    INITIAL_RTT_S,
    LONGEST_WAIT_S,
    MINIMUM_MEMORY_S,
    UNSTABLE_FLOOR_S,
    RttEstimator,
)


def test_before_the_first_sample_the_initial_guess_holds() -> None:
    rtt = RttEstimator()
    assert not rtt.has_sample
    assert rtt.probe_timeout(0.005) == rtt.silence_limit() == 2 * INITIAL_RTT_S
    assert rtt.loss_delay() == pytest.approx(9 / 8 * INITIAL_RTT_S)


def test_the_first_sample_is_taken_whole_and_the_next_are_smoothed() -> None:
    rtt = RttEstimator()
    rtt.sample(0.100, 0.0)
    assert (rtt.smoothed, rtt.variation, rtt.minimum, rtt.latest) == (0.1, 0.05, 0.1, 0.1)
    rtt.sample(0.180, 0.0)
    assert rtt.smoothed == pytest.approx(0.110)
    assert rtt.variation == pytest.approx(0.05 * 3 / 4 + 0.08 / 4)
    assert rtt.minimum == 0.1


def test_it_converges_on_a_steady_path() -> None:
    rtt = RttEstimator()
    rtt.sample(1.0, 0.0)
    for _ in range(100):
        rtt.sample(0.05, 0.0)
    assert rtt.smoothed == pytest.approx(0.05, rel=0.01)
    assert rtt.probe_timeout(0.0) == pytest.approx(0.05, rel=0.1)
    assert rtt.silence_limit() == pytest.approx(2 * 0.05, rel=0.1)


def test_the_peers_delay_is_taken_off_but_never_below_what_was_measured_whole() -> None:
    rtt = RttEstimator()
    rtt.sample(0.050, 0.0, peer_delay_s=0.040)
    assert rtt.minimum == rtt.smoothed == 0.050
    rtt.sample(0.080, 0.0, peer_delay_s=0.020)
    assert rtt.latest == pytest.approx(0.060)
    rtt.sample(0.055, 0.0, peer_delay_s=1e6)
    assert rtt.latest == 0.055
    assert rtt.minimum == 0.050


def test_tiny_and_negative_samples_keep_the_timers_above_their_floor() -> None:
    rtt = RttEstimator()
    for _ in range(50):
        rtt.sample(-1.0, 0.0)
    assert rtt.minimum > 0
    assert rtt.loss_delay() == GRANULARITY_S
    assert rtt.probe_timeout(0.0) >= GRANULARITY_S
    assert rtt.silence_limit() == UNSTABLE_FLOOR_S


def test_what_arrives_after_an_outage_makes_nobody_wait_for_long() -> None:
    rtt = RttEstimator()
    for tick in range(100):
        rtt.sample(0.05, tick * 0.01)
    for late_s in (13.0, 12.9):
        rtt.sample(late_s, 14.0)
    assert rtt.probe_timeout(0.0) > 10
    assert rtt.silence_limit() <= 3 * LONGEST_WAIT_S


def test_a_minimum_not_seen_again_is_forgotten() -> None:
    rtt = RttEstimator()
    rtt.sample(0.010, 0.0)
    for tick in range(1, 50):
        rtt.sample(0.050, tick * 0.1)
    assert rtt.minimum == 0.010
    for tick in range(50, 50 + int(2 * MINIMUM_MEMORY_S / 0.1)):
        rtt.sample(0.050, tick * 0.1)
    assert rtt.minimum == 0.050


def test_a_minimum_seen_now_and_then_is_kept() -> None:
    rtt = RttEstimator()
    for tick in range(1000):
        rtt.sample(0.010 if tick % 40 == 0 else 0.050, tick * 0.1)
        assert rtt.minimum == 0.010


def test_a_long_pause_forgets_the_minimum() -> None:
    rtt = RttEstimator()
    rtt.sample(0.010, 0.0)
    rtt.sample(0.050, 2 * MINIMUM_MEMORY_S)
    assert rtt.minimum == 0.050
