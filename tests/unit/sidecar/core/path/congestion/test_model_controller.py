from __future__ import annotations

import pytest

from plr.sidecar.core.path.congestion.controller import RateSample
from plr.sidecar.core.path.congestion.delivery_rate import FRESH_S
from plr.sidecar.core.path.congestion.loss_ceiling import CUT
from plr.sidecar.core.path.congestion.model_controller import (
    INITIAL_WINDOW_BYTES,
    MAX_BURST_BYTES,
    MIN_WINDOW_BYTES,
    OUTAGE_FRACTION,
    PAUSE_S,
    ModelController,
    Phase,
    burst,
)
from plr.sidecar.core.path.congestion.rtt import RttEstimator
from plr.sidecar.core.path.congestion.units import DATAGRAM_BYTES

RTT_S = 0.1
RATE = 1_000_000.0


class Sender:
    """Sends a datagram whenever it may over a path of RATE, and tells the controller what comes back."""

    def __init__(self) -> None:
        self.control = ModelController()
        self.rtt = RttEstimator()
        self.now = 0.0
        self.in_flight: list[tuple[float, float]] = []
        self.busy_until = 0.0

    @property
    def bytes(self) -> int:
        return len(self.in_flight) * DATAGRAM_BYTES

    def send(self) -> int:
        """All that may leave now."""
        sent = 0
        budget = self.control.budget(self.now, self.bytes)
        while budget >= DATAGRAM_BYTES:
            self.busy_until = max(self.busy_until, self.now) + DATAGRAM_BYTES / RATE
            self.in_flight.append((self.now, self.busy_until + RTT_S))
            self.control.on_sent(self.now, DATAGRAM_BYTES, self.bytes)
            budget -= DATAGRAM_BYTES
            sent += DATAGRAM_BYTES
        return sent

    def run(self, seconds: float, *, sending: bool = True) -> None:
        end = self.now + seconds
        while self.now < end:
            if sending:
                self.send()
            else:
                self.control.ran_dry()
            while self.in_flight and self.in_flight[0][1] <= self.now:
                sent_at, _ = self.in_flight.pop(0)
                self.rtt.sample(self.now - sent_at, self.now)
                sample = RateSample(DATAGRAM_BYTES, sent_at, self.now - sent_at, self.bytes)
                self.control.on_acked(sample, self.rtt, self.now)
            self.now += 0.0005


@pytest.fixture
def cruising() -> Sender:
    sender = Sender()
    sender.run(3.0)
    assert sender.control.phase is Phase.CRUISE
    assert sender.control.rate.best == pytest.approx(RATE, rel=0.05)
    return sender


def test_an_unknown_path_gets_the_initial_window_at_once_and_no_more() -> None:
    sender = Sender()
    assert sender.send() == INITIAL_WINDOW_BYTES // DATAGRAM_BYTES * DATAGRAM_BYTES
    sender.now += RTT_S / 2
    assert sender.send() <= DATAGRAM_BYTES
    assert sender.send() == 0
    assert sender.control.next_release(sender.bytes) is None


def test_start_up_no_more_than_doubles_with_each_round_trip_and_is_soon_there() -> None:
    sender = Sender()
    sender.run(RTT_S * 1.5)
    assert sender.control.rate.best <= 2 * INITIAL_WINDOW_BYTES / RTT_S
    sender.run(RTT_S * 3.5)
    assert sender.control.rate.best == pytest.approx(RATE, rel=0.1)


def test_what_leaves_is_spread_over_time_and_the_timer_says_when_more_may(cruising: Sender) -> None:
    control = cruising.control
    cruising.run(0.2, sending=False)
    sent = 0
    while more := cruising.send():
        sent += more
    assert 0 < sent <= burst(1.25 * RATE) + 2 * PAUSE_S * 1.25 * RATE
    release = control.next_release(cruising.bytes)
    assert release is not None
    assert control.budget(cruising.now, cruising.bytes) == 0
    assert control.budget(release, cruising.bytes) >= DATAGRAM_BYTES


def test_a_sender_woken_late_makes_up_for_it_but_not_for_a_pause(cruising: Sender) -> None:
    cruising.run(0.5, sending=False)
    paused = cruising.control.budget(cruising.now, 0)
    cruising.run(0.5, sending=False)
    assert cruising.control.budget(cruising.now, 0) == paused
    assert paused <= max(burst(1.25 * RATE), PAUSE_S * 1.25 * RATE)


def test_the_window_is_a_round_trip_or_two(cruising: Sender) -> None:
    assert RATE * RTT_S < cruising.control.window < 2.5 * RATE * RTT_S
    assert cruising.control.budget(cruising.now, int(cruising.control.window) + 1) == 0
    assert cruising.control.next_release(int(cruising.control.window) + 1) is None


def test_a_pause_keeps_the_rate(cruising: Sender) -> None:
    cruising.run(30.0, sending=False)
    assert cruising.control.rate.best == pytest.approx(RATE, rel=0.05)


@pytest.mark.audit("dp-6")
def test_a_burst_proves_a_rate_that_nothing_confirmed_for_some_time(cruising: Sender) -> None:
    control = cruising.control
    before = control.window
    cruising.run(FRESH_S - RTT_S, sending=False)
    control.budget(cruising.now, 0)
    assert control.window == before
    cruising.run(3 * RTT_S, sending=False)  # the last acknowledgements came later
    control.budget(cruising.now, 0)
    assert control.window == INITIAL_WINDOW_BYTES
    assert control.rate.best == pytest.approx(RATE, rel=0.05)
    cruising.run(1.3 * RTT_S)
    assert control.window > 0.9 * before


def test_after_an_outage_it_starts_from_a_part_of_the_rate(cruising: Sender) -> None:
    control = cruising.control
    for _ in range(5):  # its probe timeouts come first
        cruising.now += 1.0
        control.on_probe_timeout(cruising.now)
    control.on_path_down()
    control.on_path_up(cruising.now)
    assert control.phase is Phase.STARTUP
    assert control.rate.best == pytest.approx(OUTAGE_FRACTION * RATE, rel=0.1)


def test_coming_up_without_having_been_down_changes_nothing(cruising: Sender) -> None:
    cruising.control.on_path_up(cruising.now)
    assert cruising.control.phase is Phase.CRUISE


def test_persistent_congestion_leaves_the_least(cruising: Sender) -> None:
    control = cruising.control
    control.on_probe_timeout(cruising.now + 0.1)
    assert control.window > MIN_WINDOW_BYTES
    control.on_probe_timeout(cruising.now + 2.0)
    assert control.window < 3 * MIN_WINDOW_BYTES
    assert control.phase is Phase.STARTUP


def test_a_probe_timeout_lets_two_datagrams_leave_although_the_window_is_full(cruising: Sender) -> None:
    control, full = cruising.control, 10_000_000
    assert control.budget(cruising.now, full) == 0
    control.on_probe_timeout(cruising.now)
    assert control.budget(cruising.now, full) == 2 * DATAGRAM_BYTES
    control.on_sent(cruising.now, 2 * DATAGRAM_BYTES, full)
    assert control.budget(cruising.now, full) == 0


def test_a_loss_without_a_queue_changes_nothing(cruising: Sender) -> None:
    before = cruising.control.window
    cruising.control.on_lost(2 * DATAGRAM_BYTES, cruising.now, cruising.bytes, cruising.now)
    assert cruising.control.window == before


def test_heavy_loss_among_few_bytes_does_not_cut_below_what_the_path_is_known_to_carry(cruising: Sender) -> None:
    cruising.run(2.0, sending=False)  # the application asks for little
    for _ in range(2):
        cruising.control.ceiling.end_round(cruising.rtt, cruising.now)
    few = 20 * DATAGRAM_BYTES
    cruising.control.on_sent(cruising.now, few, few)
    cruising.control.on_lost(few, cruising.now, 0, cruising.now)
    assert cruising.control.ceiling.bytes is not None
    assert cruising.control.window >= 0.9 * CUT * RATE * RTT_S


def test_the_minimum_is_looked_for_again_when_it_was_not_seen_for_long(cruising: Sender) -> None:
    cruising.rtt.restart_minimum(RTT_S / 2, cruising.now)
    phases = set()
    for _ in range(200):
        cruising.run(0.05)
        phases.add(cruising.control.phase)
    assert Phase.PROBE_RTT in phases
    assert cruising.rtt.minimum == pytest.approx(RTT_S, rel=0.1)


@pytest.mark.parametrize(("pace", "expected"), [(1e3, 2 * DATAGRAM_BYTES), (10e6, 10_000), (1e9, MAX_BURST_BYTES)])
def test_a_burst_is_a_millisecond_within_its_bounds(pace: float, expected: int) -> None:
    assert burst(pace) == expected
