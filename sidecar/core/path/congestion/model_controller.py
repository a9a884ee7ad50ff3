"""Decides how much may be in flight on one path, and when the next burst may leave.

It models the path after BBR (draft-ietf-ccwg-bbr): the delivery rate and the round trip of an empty queue say how fast
to send and how much to have in flight. Losses that mean congestion put a ceiling on that. For the reasons see
docs/develop/adr/0010-congestion-by-model-and-ceiling.md.
"""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING

from plr.sidecar.core.path.congestion.bandwidth_search import BandwidthSearch, is_faster
from plr.sidecar.core.path.congestion.controller import MAX_WINDOW_BYTES
from plr.sidecar.core.path.congestion.delivery_rate import DeliveryRate
from plr.sidecar.core.path.congestion.loss_ceiling import LossCeiling
from plr.sidecar.core.path.congestion.policer import Policer
from plr.sidecar.core.path.congestion.units import DATAGRAM_BYTES, END_HOST_S

if TYPE_CHECKING:
    from plr.sidecar.core.path.congestion.controller import RateSample
    from plr.sidecar.core.path.congestion.rtt import RttEstimator

INITIAL_WINDOW_BYTES = 32 * 1024
"""Bytes that may leave at once on an unknown path: within what browsers do (RFC 6928 says 14 kB for TCP), and such that
small requests never wait for an estimate."""
MIN_WINDOW_BYTES = 4 * DATAGRAM_BYTES
"""Always allowed in flight, to keep acknowledgements coming (RFC 8085 section 3.1 asks for a small minimum)."""
MAX_BURST_BYTES = 64 * 1024
"""Largest burst between two pauses: one segmentation offload."""
UNPROVEN_S = 0.005
"""If nothing confirmed the rate for some time, the first burst is what the path carries in this time, and no less than
on an unknown path: after a fall to a fiftieth, a quarter of a second in the modem. Its acknowledgements prove the rate.
"""
BURST_S = 0.001
"""A burst is what the path carries in this time, if that is more than two datagrams."""
LATE_S = 0.025
"""Most time that a sender woken late makes up for: a busy host's threads wait for their turn. Any further lateness
keeps its pace below the estimated rate, and then sending a quarter more may ask for nothing."""
PAUSE_S = 0.004
"""After a pause, what the path carries in this time may leave at once: on a fast path, a whole small request."""
WINDOW_GAIN = 2.0
"""Bandwidth-delay products in flight: what clumped acknowledgements need."""
STARTUP_GAIN = 2.0
"""At first the rate at most doubles with each round, as in slow start."""
DRAIN_GAIN = 0.5
"""Gain after start-up, until its queue is gone."""
DRAIN_ROUNDS = 3
"""Draining ends after this many rounds: a queue that still stands then is not ours."""
QUEUE_FACTOR = 0.25
"""A round trip this much above the minimum shows a queue."""
PROBE_AGAIN_S = 1.0
"""Least time between two searches for the minimum because a queue stands although we keep to our window."""
MINIMUM_STALE_S = 5.0
"""A minimum round trip not seen for this long is looked for, with half the window, before it is forgotten."""
OUTAGE_FRACTION = 0.5
"""Share of its earlier rate that a path is believed to carry after it was down."""


class Phase(Enum):
    """What the sender is doing."""

    STARTUP = "startup"
    DRAIN = "drain"
    CRUISE = "cruise"
    PROBE_RTT = "probe_rtt"


class ModelController:
    """A `CongestionController`. Sizes in bytes, rates in bytes a second, times in seconds."""

    __slots__ = (
        "_believed_before",
        "_collapsed_at",
        "_drained_at",
        "_first_window",
        "_phase_rounds",
        "_probe_credit",
        "_probe_min_rtt",
        "_probed_rtt_at",
        "_rate_before_silence",
        "_release_at",
        "_round_max_rtt",
        "_round_min_rtt",
        "_rtt",
        "_search",
        "_silent_since",
        "_standing_rounds",
        "_unproven_bytes",
        "_was_down",
        "ceiling",
        "phase",
        "policer",
        "rate",
    )

    def __init__(self) -> None:
        self.phase = Phase.STARTUP
        self.rate = DeliveryRate()
        self.ceiling = LossCeiling()
        self.policer = Policer()
        self._rtt: RttEstimator | None = None
        self._first_window = float(INITIAL_WINDOW_BYTES)
        self._release_at = 0.0
        self._probe_credit = 0
        self._was_down = False
        self._silent_since = 0.0
        self._collapsed_at = float("-inf")
        self._rate_before_silence = 0.0
        self._search = BandwidthSearch()
        self._unproven_bytes: float | None = None
        """Most bytes in flight until a burst's first acknowledgements prove a rate that nothing confirmed for long."""
        self._phase_rounds = 0
        self._standing_rounds = 0
        self._believed_before = 0.0
        self._probed_rtt_at: float | None = None
        self._probe_min_rtt = float("inf")
        self._drained_at: float | None = None
        self._round_min_rtt = float("inf")
        self._round_max_rtt = 0.0

    # -- queries --------------------------------------------------------------------------------------------------

    def budget(self, now: float, in_flight: int) -> int:
        """Return the bytes that may leave now: 0, or at least one datagram."""
        if self.rate.is_dry:
            self._validate(now)
        room = self.window - in_flight
        if room <= 0:
            return self._probe_credit
        pace = self.pacing_rate
        if pace is not None:
            if now < self._release_at:
                return 0
            late = min(now - self._release_at, self._allowance_s) * pace
            room = min(room, max(burst(pace), late))
        return max(int(room), DATAGRAM_BYTES)

    def _validate(self, now: float) -> None:
        """Let a first burst prove a rate that nothing confirmed for some time (RFC 7661; RFC 9002 section 7.8)."""
        if self.rate.best and not self.rate.is_confirmed(now):
            if self._unproven_bytes is None and self.phase is Phase.CRUISE:
                self._look_for_more()
            self._unproven_bytes = max(float(INITIAL_WINDOW_BYTES), UNPROVEN_S * self.rate.best)

    @property
    def _allowance_s(self) -> float:
        allowed_s = PAUSE_S if self.rate.is_dry else LATE_S
        policed = self.policer.rate
        return allowed_s if policed is None else min(allowed_s, self.policer.burst / policed)

    def next_release(self, in_flight: int) -> float | None:
        """Return when pacing lets more leave, even if past; None if only an acknowledgement can."""
        if in_flight >= self.window or self.pacing_rate is None:
            return None
        return self._release_at

    @property
    def window(self) -> float:
        """Bytes that may be in flight."""
        model = self._model_window()
        if self.ceiling.bytes is not None:
            model = min(model, self.ceiling.bytes)
        if self._unproven_bytes is not None:
            model = min(model, self._unproven_bytes)
        least = MIN_WINDOW_BYTES if self.phase is not Phase.PROBE_RTT else MIN_WINDOW_BYTES / 2
        return min(max(model, least), MAX_WINDOW_BYTES)

    def _model_window(self) -> float:
        rate = self.rate.best
        if not rate or self._rtt is None:
            return self._first_window
        product = rate * self._rtt.minimum
        if self.phase is Phase.PROBE_RTT:
            return product / 2
        model = WINDOW_GAIN * product + rate * END_HOST_S + 2 * DATAGRAM_BYTES
        return max(model, self._first_window) if self.phase is Phase.STARTUP else model

    @property
    def pacing_rate(self) -> float | None:
        """Bytes a second; None while the path is unknown."""
        model, policed = self._model_pace(), self.policer.rate
        return model if model is None or policed is None else min(model, policed)

    def _model_pace(self) -> float | None:
        rate = self.rate.best
        if not rate or self._rtt is None:
            return None
        if self.phase is Phase.STARTUP:
            if self._search.met_queue:
                return DRAIN_GAIN * rate  # as if it were full; the next round tells
            return max(STARTUP_GAIN * rate, self._first_window / max(self._rtt.smoothed, 1e-4))
        if self.phase is Phase.DRAIN:
            return DRAIN_GAIN * rate
        if self.phase is Phase.PROBE_RTT:
            return rate
        return self._search.gain * rate

    def take_policed(self) -> bool:
        """Return whether a policer was found since the last call."""
        found, self.policer.was_found = self.policer.was_found, False
        return found

    # -- inputs ---------------------------------------------------------------------------------------------------

    def on_sent(self, now: float, size: int, in_flight: int) -> None:
        """Note that these bytes left; `in_flight` includes them."""
        allowance_s = self._allowance_s
        self.rate.on_sent(now)
        self.policer.on_sent(now)
        self._probe_credit = 0
        if in_flight <= size:
            self._silent_since = now
        self.ceiling.on_sent(in_flight)
        pace = self.pacing_rate
        if pace is not None:
            self._release_at = max(self._release_at, now - allowance_s) + size / pace

    def ran_dry(self) -> None:
        """Note that nothing waits although more may leave: later deliveries say little of what the path can carry."""
        self.rate.ran_dry()
        self.policer.ran_dry()

    def on_acked(self, sample: RateSample, rtt: RttEstimator, now: float) -> None:
        """Learn from an acknowledgement."""
        self._rtt = rtt
        self._silent_since = now
        self._rate_before_silence = 0.0
        if sample.rtt_s:
            self._round_min_rtt = min(self._round_min_rtt, sample.rtt_s)
            self._round_max_rtt = max(self._round_max_rtt, sample.rtt_s)
            if self._probed_rtt_at is None or sample.rtt_s <= 1.05 * rtt.minimum + 1e-4:
                self._probed_rtt_at = now
            if self.phase is Phase.PROBE_RTT:
                self._probe_rtt(sample, rtt, now)
        limit = STARTUP_GAIN * (self.rate.settled or self._first_window / max(rtt.minimum, 1e-4))
        held_back = self._unproven_bytes is not None or self.policer.rate is not None
        held_back = held_back or self.phase is Phase.PROBE_RTT or self._ceiling_binds(rtt)
        self.policer.on_acked(sample.acked_bytes, sample.sent_at)
        round_over = self.rate.on_acked(sample.acked_bytes, sample.sent_at, now, limit, held_back=held_back)
        if self.rate.is_confirmed(now):
            self._unproven_bytes = None
        elif self._unproven_bytes is not None and not self._stands(sample.rtt_s or float("inf"), rtt):
            self._unproven_bytes += sample.acked_bytes  # as in slow start, where acknowledgements come in clumps
        self.ceiling.on_acked(sample.acked_bytes, sample.rtt_s, rtt, self._model_window(), now)
        if self.phase is Phase.DRAIN and sample.in_flight <= self.rate.best * rtt.minimum:
            self._cruise()
        if round_over:
            self._end_round(rtt, now)

    def _ceiling_binds(self, rtt: RttEstimator) -> bool:
        """Return whether less is in flight than the path holds, so that a round without a queue tells no rate."""
        if self.ceiling.bytes is None or self.ceiling.bytes >= self._model_window():
            return False
        return not self._stands(self._round_min_rtt, rtt)

    @staticmethod
    def _stands(round_min_rtt: float, rtt: RttEstimator) -> bool:
        return rtt.minimum + QUEUE_FACTOR * rtt.minimum + END_HOST_S < round_min_rtt < float("inf")

    def on_lost(self, lost_bytes: int, sent_at: float, in_flight: int, now: float) -> None:
        """Take a loss of these bytes, the newest of them sent at `sent_at`; `in_flight` is what is left."""
        rtt = self._rtt
        if rtt is None or sent_at <= self._collapsed_at:
            return  # the restart at the minimum answered that loss, which says nothing about what was sent since
        # The queue that start-up overflows fills in one round: no queue stands yet.
        queued = self.phase is Phase.STARTUP and self._stands(self._round_max_rtt, rtt)
        queued = queued or self.ceiling.meets_queue(rtt)
        if self.policer.on_lost(lost_bytes, sent_at, rtt.smoothed, now, queued=queued):
            self.ceiling.forget()
            return
        # Count what the path is known to carry, if the application asked for less: a loss among few bytes in flight
        # does not show that the path ends there, and a ceiling that low would take many seconds to grow back.
        known = int(self.rate.best * rtt.minimum)
        if not self.ceiling.on_lost(lost_bytes, sent_at, max(in_flight, known), rtt, now):
            return
        if self.phase is Phase.STARTUP:
            self._enter(Phase.DRAIN)

    def on_spurious(self, size: int) -> None:
        """Note that these bytes arrived although they were reported lost."""
        self.policer.on_spurious(size)

    def on_probe_timeout(self, now: float) -> None:
        """Let two datagrams leave whatever is in flight, since nothing was heard (RFC 9002 section 7.5)."""
        self._probe_credit = 2 * DATAGRAM_BYTES
        rtt = self._rtt
        if rtt is not None and now - self._silent_since > rtt.persistent_congestion(END_HOST_S):
            self._collapse(rtt, now)

    def on_path_down(self) -> None:
        """Note that the path is dead."""
        self._was_down = True
        self.rate.restart(OUTAGE_FRACTION * max(self.rate.best, self._rate_before_silence))
        self._rate_before_silence = 0.0
        self.ceiling.forget()

    def on_path_up(self, now: float) -> None:
        """Note that the path answers; after an outage, start from a share of its earlier rate, and look for more."""
        if not self._was_down:
            return
        self._was_down = False
        self._enter(Phase.STARTUP)
        self._first_window = float(MIN_WINDOW_BYTES) if self.rate.best else float(INITIAL_WINDOW_BYTES)
        self._search.restart()
        self._probed_rtt_at = now
        if self._rtt is not None:
            self._rtt.restart_minimum(self._rtt.latest, now)

    # -- rounds ---------------------------------------------------------------------------------------------------

    def _end_round(self, rtt: RttEstimator, now: float) -> None:
        standing_s = self._round_min_rtt - rtt.minimum if self._round_min_rtt < float("inf") else 0.0
        queued = self._stands(self._round_min_rtt, rtt)
        round_max_rtt = self._round_max_rtt
        self._round_min_rtt, self._round_max_rtt = float("inf"), 0.0
        self._phase_rounds += 1
        self.ceiling.end_round(rtt, now)
        self.policer.end_round(now)
        if standing_s > rtt.minimum + 2 * END_HOST_S:
            self._standing_rounds += 1
            self._believed_before = max(self._believed_before, self.rate.best)
            self.rate.believe_latest()
        else:
            self._standing_rounds = 0
            self._believed_before = 0.0
        if self.phase is Phase.STARTUP:
            if self._search.is_full(self.rate, queued=queued):
                self._enter(Phase.DRAIN)
            if standing_s > rtt.minimum + 2 * END_HOST_S:
                self._enter(Phase.DRAIN)  # longer than a busy host makes wait
        elif self.phase is Phase.DRAIN and self._phase_rounds > DRAIN_ROUNDS:
            self._cruise()
        elif self.phase is Phase.CRUISE:
            if not self.rate.limited_by_sender and is_faster(self.rate.best, round_max_rtt, rtt.minimum):
                self._look_for_more()
                return
            if self._search.finds_more(self.rate.settled, queued=queued):
                self._look_for_more()
            unseen_s = now - (self._probed_rtt_at or now)
            if unseen_s > MINIMUM_STALE_S or (self._standing_rounds > 1 and unseen_s > PROBE_AGAIN_S):
                self._enter(Phase.PROBE_RTT)
                self._drained_at = None
                self._probe_min_rtt = float("inf")

    def _probe_rtt(self, sample: RateSample, rtt: RttEstimator, now: float) -> None:
        """Look for the minimum: with little of ours in flight for a round trip, the remaining queue is others'."""
        self._probe_min_rtt = min(self._probe_min_rtt, sample.rtt_s)
        if self._drained_at is None:
            if sample.in_flight <= self.window:
                self._drained_at = now
        elif sample.sent_at >= self._drained_at:
            if self._believed_before and self._probe_min_rtt > 2 * rtt.minimum:
                # The queue is others': the path is not slower than thought. But they may all be slower than before.
                self.rate.restart(min(self._believed_before, STARTUP_GAIN * self.rate.best))
            self._believed_before = 0.0
            rtt.restart_minimum(self._probe_min_rtt, now)
            self._probed_rtt_at = now
            self._cruise()

    def _look_for_more(self) -> None:
        """Search again by doubling, since the path carries more than estimated."""
        self._enter(Phase.STARTUP)
        self._first_window = float(MIN_WINDOW_BYTES)
        self._search.restart()

    def _enter(self, phase: Phase) -> None:
        self.phase = phase
        self._phase_rounds = 0

    def _cruise(self) -> None:
        self._enter(Phase.CRUISE)
        self._search.begin_cycle()

    def _collapse(self, rtt: RttEstimator, now: float) -> None:
        """Restart at the minimum after persistent congestion (RFC 9002 section 7.6.2), unless it was an outage."""
        self._collapsed_at = now
        self._rate_before_silence = max(self._rate_before_silence, self.rate.best)
        self.rate.restart(MIN_WINDOW_BYTES / max(rtt.smoothed, 1e-3))
        self.ceiling.forget()
        self._first_window = float(MIN_WINDOW_BYTES)
        self._enter(Phase.STARTUP)
        self._search.restart()


def burst(pace: float) -> float:
    """Return the bytes that leave together at a pacing rate (bytes a second)."""
    return max(2.0 * DATAGRAM_BYTES, min(pace * BURST_S, MAX_BURST_BYTES))
