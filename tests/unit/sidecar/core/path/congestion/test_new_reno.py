from __future__ import annotations

import pytest

from plr.sidecar.core.path.congestion.controller import MAX_WINDOW_BYTES, RateSample
from plr.sidecar.core.path.congestion.new_reno import INITIAL_WINDOW_BYTES, MIN_WINDOW_BYTES, PACING_GAIN, NewReno
from plr.sidecar.core.path.congestion.rtt import RttEstimator
from plr.sidecar.core.path.congestion.units import DATAGRAM_BYTES

RTT_S = 0.1


class Sender:
    """Sends a whole window at once, and hears of it a round trip later."""

    def __init__(self) -> None:
        self.control = NewReno()
        self.rtt = RttEstimator()
        self.now = 0.0

    def round(self, *, dry: bool = False) -> None:
        """Send a window, and have it acknowledged in ten parts."""
        window, sent_at = int(self.control.window), self.now
        self.control.budget(sent_at, 0)
        self.control.on_sent(sent_at, window, window)
        if dry:
            self.control.ran_dry()
        self.now += RTT_S
        for part in range(1, 11):
            left = window - part * window // 10
            acked = part * window // 10 - (part - 1) * window // 10
            self.rtt.sample(RTT_S, self.now)
            self.control.on_acked(RateSample(acked, sent_at, RTT_S, left), self.rtt, self.now)


@pytest.fixture
def avoiding() -> Sender:
    """In congestion avoidance."""
    sender = Sender()
    for _ in range(4):
        sender.round()
    sender.control.on_lost(DATAGRAM_BYTES, sender.now, 0, sender.now)
    sender.now += RTT_S
    return sender


def test_slow_start_doubles_the_window_in_each_round() -> None:
    sender = Sender()
    for doubled in (2, 4, 8):
        sender.round()
        assert sender.control.window == pytest.approx(doubled * INITIAL_WINDOW_BYTES, rel=0.01)


def test_a_loss_halves_the_window_and_ends_slow_start(avoiding: Sender) -> None:
    before = avoiding.control.window
    assert before == pytest.approx(8 * INITIAL_WINDOW_BYTES, rel=0.01)
    avoiding.round()
    assert avoiding.control.window - before == pytest.approx(DATAGRAM_BYTES, rel=0.1), "a datagram for each round"


def test_the_losses_of_one_round_trip_count_once(avoiding: Sender) -> None:
    control, now = avoiding.control, avoiding.now
    control.on_lost(DATAGRAM_BYTES, now, 0, now)
    cut = control.window
    control.on_lost(DATAGRAM_BYTES, now - RTT_S / 2, 0, now + RTT_S / 2)
    assert control.window == cut
    control.on_lost(DATAGRAM_BYTES, now + RTT_S, 0, now + 2 * RTT_S)
    assert control.window == cut / 2


def test_what_left_before_a_loss_does_not_grow_the_window(avoiding: Sender) -> None:
    control, now = avoiding.control, avoiding.now
    control.on_lost(DATAGRAM_BYTES, now, 0, now)
    cut = control.window
    control.on_acked(RateSample(10 * DATAGRAM_BYTES, now - RTT_S / 2, RTT_S, 0), avoiding.rtt, now + RTT_S / 2)
    assert control.window == cut


def test_a_window_that_was_not_used_up_does_not_grow() -> None:
    sender = Sender()
    sender.round(dry=True)
    assert sender.control.window == INITIAL_WINDOW_BYTES
    sender.round()
    assert sender.control.window == 2 * INITIAL_WINDOW_BYTES


def test_a_long_silence_starts_from_the_minimum_with_slow_start_up_to_half_of_what_was() -> None:
    sender = Sender()
    for _ in range(4):
        sender.round()
    control, before = sender.control, sender.control.window
    control.on_sent(sender.now, 2 * DATAGRAM_BYTES, 2 * DATAGRAM_BYTES)
    control.on_probe_timeout(sender.now + RTT_S)
    assert control.window == before, "not silent for long enough"
    control.on_probe_timeout(sender.now + 2.0)
    assert control.window == MIN_WINDOW_BYTES
    control.on_probe_timeout(sender.now + 3.0)
    sender.now += 3.1
    for _ in range(4):
        sender.round()
    assert control.window == pytest.approx(16 * MIN_WINDOW_BYTES, rel=0.01)
    for _ in range(4):
        sender.round()
    assert before / 2 <= control.window < 0.6 * before


def test_an_outage_leaves_no_more_than_the_initial_window(avoiding: Sender) -> None:
    avoiding.control.on_path_down()
    avoiding.control.on_path_up(avoiding.now)
    assert avoiding.control.window == INITIAL_WINDOW_BYTES
    avoiding.round()
    assert avoiding.control.window == pytest.approx(2 * INITIAL_WINDOW_BYTES, rel=0.01)


def test_the_window_is_spread_over_the_round_trip(avoiding: Sender) -> None:
    avoiding.round()
    control, pace = avoiding.control, PACING_GAIN * avoiding.control.window / RTT_S
    assert control.pacing_rate == pytest.approx(pace)
    burst = control.budget(avoiding.now + 1.0, 0)
    assert burst == INITIAL_WINDOW_BYTES, "what may leave at once after a pause"
    control.on_sent(avoiding.now + 1.0, burst, burst)
    release = control.next_release(burst)
    assert release is not None
    assert control.budget(release + 0.005, burst) == pytest.approx(0.005 * pace, abs=1)


def test_no_window_is_longer_than_any_path_needs() -> None:
    sender = Sender()
    for _ in range(15):
        sender.round()
    assert sender.control.window == MAX_WINDOW_BYTES
