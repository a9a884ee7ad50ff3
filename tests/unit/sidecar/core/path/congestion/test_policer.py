from __future__ import annotations

import pytest

from plr.sidecar.core.path.congestion.policer import FORGET, MARGIN, Policer
from plr.sidecar.core.path.congestion.units import DATAGRAM_BYTES

RTT_S = 0.05
TOKENS = 500_000.0


class Sender:
    """Sends steadily as fast as it may, at most `pace`; a bucket without depth drops, or chance does."""

    def __init__(self, pace: float, *, every: int = 0) -> None:
        self.policer = Policer()
        self.pace = pace
        self.every = every
        """Loses each so-manieth datagram at random; 0: a policer does."""
        self.now = 0.0
        self.sent = self.lost = 0
        self._tokens = 0.0
        self._round = 0.0

    def run(self, seconds: float, *, queued: bool = False, dry: bool = False) -> None:
        end = self.now + seconds
        while self.now < end:
            gap = DATAGRAM_BYTES / min(self.pace, self.policer.rate or self.pace)
            self.now += gap
            self.policer.on_sent(self.now)
            self.sent += 1
            self._tokens = min(self._tokens + gap * TOKENS, 3.0 * DATAGRAM_BYTES)
            drops = self.sent % self.every == 0 if self.every else self._tokens < DATAGRAM_BYTES
            if drops:
                self.lost += 1
                self.policer.on_lost(DATAGRAM_BYTES, self.now, RTT_S, self.now, queued=queued)
            else:
                self._tokens -= DATAGRAM_BYTES
                self.policer.on_acked(DATAGRAM_BYTES, self.now)
            if dry:
                self.policer.ran_dry()
            if self.now - self._round > RTT_S:
                self._round = self.now
                self.policer.end_round(self.now)

    def run_until_tried(self) -> None:
        while self.policer.rate is None:
            self.run(0.01)


def test_nothing_is_known_at_first() -> None:
    assert Policer().rate is None


def test_the_token_rate_is_found_and_a_little_less_is_used() -> None:
    sender = Sender(2 * TOKENS)
    sender.run(1.0)
    assert sender.policer.rate == pytest.approx(MARGIN * TOKENS, rel=0.03)
    assert sender.policer.was_found
    lost = sender.lost
    sender.run(1.0)
    assert sender.lost == lost


def test_more_is_looked_for_and_given_up_again() -> None:
    sender = Sender(2 * TOKENS)
    sender.run(2.0)
    before = sender.sent, sender.lost
    sender.run(20.0)
    assert sender.lost - before[1] < 0.02 * (sender.sent - before[0])
    assert sender.sent - before[0] > 0.95 * 20.0 * TOKENS / DATAGRAM_BYTES


def test_a_policer_that_is_gone_is_forgotten() -> None:
    sender = Sender(4 * TOKENS)
    sender.run(2.0)
    assert sender.policer.was_found
    sender.every = 10**9
    sender.run(10.0)
    assert sender.policer.rate is None
    assert FORGET * TOKENS < sender.pace


@pytest.mark.parametrize("every", [3, 6, 8])
def test_losses_that_do_not_end_at_a_lower_rate_are_no_policer(every: int) -> None:
    sender = Sender(2 * TOKENS, every=every)
    sender.run(5.0)
    assert sender.policer.rate is None
    assert not sender.policer.was_found


@pytest.mark.audit("dp-9")
def test_losses_of_a_trial_count_though_they_meet_a_queue() -> None:
    sender = Sender(2 * TOKENS, every=6)
    sender.run_until_tried()
    sender.run(5.0, queued=True)
    assert sender.policer.rate is None
    assert not sender.policer.was_found


@pytest.mark.audit("dp-9")
def test_a_policer_found_by_chance_is_given_up_when_as_much_is_lost_as_before() -> None:
    sender = Sender(2 * TOKENS, every=6)
    sender.run_until_tried()
    sender.every = 10**9
    while not sender.policer.was_found:
        sender.run(0.01)
    sender.every = 6
    sender.run(1.0)
    assert sender.policer.rate is None


def test_a_few_losses_are_no_reason_for_a_trial() -> None:
    sender = Sender(2 * TOKENS, every=15)
    sender.run(10.0)
    assert sender.policer.rate is None
    assert sender.policer.burst == 0.0


def test_losses_that_met_a_queue_tell_nothing() -> None:
    sender = Sender(2 * TOKENS)
    sender.run(5.0, queued=True)
    assert sender.policer.rate is None


def test_what_the_application_limits_measures_no_rate() -> None:
    sender = Sender(2 * TOKENS)
    sender.run(5.0, dry=True)
    assert sender.policer.rate is None
