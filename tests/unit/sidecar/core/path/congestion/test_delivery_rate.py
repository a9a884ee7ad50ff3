from __future__ import annotations

import pytest

from plr.sidecar.core.path.congestion.delivery_rate import BELIEVED_ROUNDS, MAX_TRAINS, ROUNDS, DeliveryRate

SIZE = 1200
RTT_S = 0.05
NO_LIMIT = 1e12


class Link:
    """Carries datagrams at a rate; the estimator hears of each acknowledgement."""

    def __init__(self, rate: float) -> None:
        self.estimate = DeliveryRate()
        self.rate = rate
        self.now = 0.0
        self.busy_until = 0.0

    def burst(self, datagrams: int, *, pace: float | None = None) -> None:
        """Send so many at a pace (at once if None), take their acknowledgements, and run dry."""
        acks = []
        for _ in range(datagrams):
            self.estimate.on_sent(self.now)
            self.busy_until = max(self.now, self.busy_until) + SIZE / self.rate
            acks.append((self.busy_until + RTT_S, self.now))
            if pace is not None:
                self.estimate.ran_dry()
                self.now += SIZE / pace
        self.estimate.ran_dry()
        for at, sent_at in acks:
            self.estimate.on_acked(SIZE, sent_at, at, NO_LIMIT)
        self.now = max(self.now, acks[-1][0])


def test_one_burst_measures_the_link_and_not_the_application() -> None:
    link = Link(1e6)
    link.burst(100)
    assert link.estimate.best == pytest.approx(1e6, rel=0.02)
    for _ in range(20):
        link.now += 5.0
        link.burst(100)
    assert link.estimate.best == pytest.approx(1e6, rel=0.02)


def test_a_few_datagrams_measure_nothing() -> None:
    link = Link(1e6)
    for _ in range(50):
        link.burst(5)
    assert link.estimate.best == 0.0


def test_what_is_offered_slowly_lowers_nothing() -> None:
    link = Link(1e6)
    link.burst(100)
    for _ in range(3 * ROUNDS):
        link.burst(100, pace=1e5)
    assert link.estimate.best == pytest.approx(1e6, rel=0.02)


def test_a_link_that_became_slower_is_believed_in_time() -> None:
    link = Link(1e6)
    link.burst(100)
    link.rate = 1e5
    for _ in range(ROUNDS + 1):
        link.burst(100)
    assert link.estimate.best == pytest.approx(1e5, rel=0.02)


def test_a_standing_queue_makes_only_the_latest_rounds_count() -> None:
    link = Link(1e6)
    for _ in range(ROUNDS):
        link.burst(100)
    link.rate = 1e5
    for _ in range(BELIEVED_ROUNDS):
        link.burst(100)
    link.burst(1)  # its acknowledgement ends the round before
    assert link.estimate.best == pytest.approx(1e6, rel=0.02)
    link.estimate.believe_latest()
    assert link.estimate.best == pytest.approx(1e5, rel=0.02)


def test_acknowledgements_in_a_clump_show_no_more_than_the_sending_rate_and_the_limit() -> None:
    estimate = DeliveryRate()
    for number in range(100):
        estimate.on_sent(number * 0.001)
    for number in range(100):
        estimate.on_acked(SIZE, number * 0.001, 1.0 + number * 1e-6, NO_LIMIT)
    assert estimate.best <= SIZE / 0.001 * 1.05
    clumped = DeliveryRate()
    clumped.on_sent(0.0)
    for number in range(100):
        clumped.on_acked(SIZE, 0.0, 1.0 + number * 1e-6, 5e6)
    assert clumped.best == 5e6


def test_trains_under_way_are_bounded() -> None:
    estimate = DeliveryRate()
    for number in range(10 * MAX_TRAINS):
        estimate.on_sent(number * 0.001)
        estimate.ran_dry()
    assert len(estimate._trains) <= MAX_TRAINS


def test_it_begins_again_from_a_given_rate() -> None:
    link = Link(1e6)
    link.burst(100)
    link.estimate.restart(3e5)
    assert link.estimate.best == 3e5
    link.burst(100)
    assert link.estimate.best == pytest.approx(1e6, rel=0.02)
