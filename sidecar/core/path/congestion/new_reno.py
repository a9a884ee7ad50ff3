"""Halves the window at each loss, and otherwise adds a datagram per round: NewReno as RFC 9002 section 7 has it.

It takes each loss for congestion, and fills every buffer. It is here to be compared with.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.sidecar.core.path.congestion.controller import MAX_WINDOW_BYTES
from plr.sidecar.core.path.congestion.units import DATAGRAM_BYTES, END_HOST_S

if TYPE_CHECKING:
    from plr.sidecar.core.path.congestion.controller import RateSample
    from plr.sidecar.core.path.congestion.rtt import RttEstimator

INITIAL_WINDOW_BYTES = 10 * DATAGRAM_BYTES
"""Bytes that may leave at once on an unknown path, and the largest burst (RFC 9002 sections 7.2 and 7.7)."""
MIN_WINDOW_BYTES = 2 * DATAGRAM_BYTES
"""Always allowed in flight (RFC 9002 section 7.2)."""
LOSS_REDUCTION = 0.5
"""Share of the window that remains after a loss (RFC 9002 section 7.3.2)."""
PACING_GAIN = 1.25
"""Pace over window per round trip, so that variations of the round trip leave no window unused (RFC 9002 section 7.7).
"""


class NewReno:
    """A `CongestionController`: slow start, congestion avoidance and recovery."""

    __slots__ = ("_heard_at", "_probe_credit", "_recovery_since", "_release_at", "_rtt", "_threshold", "_underused",
                 "_window")  # fmt: skip

    def __init__(self) -> None:
        self._window = float(INITIAL_WINDOW_BYTES)
        self._threshold = float("inf")
        """Slow start ends at this window."""
        self._recovery_since = float("-inf")
        """When the last recovery period began: losses of what left before are answered."""
        self._underused = False
        """Whether the sender had nothing to send although the window had room."""
        self._rtt: RttEstimator | None = None
        self._release_at = 0.0
        self._probe_credit = 0
        self._heard_at = 0.0
        """When something was acknowledged, or left with nothing else in flight."""

    # -- queries --------------------------------------------------------------------------------------------------

    def budget(self, now: float, in_flight: int) -> int:
        """See `CongestionController`."""
        self._underused = False
        room = self._window - in_flight
        if room <= 0:
            return self._probe_credit
        pace = self.pacing_rate
        if pace is not None:
            if now < self._release_at:
                return 0
            credit = min((now - self._release_at) * pace, float(INITIAL_WINDOW_BYTES))
            room = min(room, max(credit, 2.0 * DATAGRAM_BYTES))
        return max(int(room), DATAGRAM_BYTES)

    def next_release(self, in_flight: int) -> float | None:
        """See `CongestionController`."""
        if in_flight >= self._window or self.pacing_rate is None:
            return None
        return self._release_at

    @property
    def window(self) -> float:
        """Bytes that may be in flight."""
        return self._window

    @property
    def pacing_rate(self) -> float | None:
        """Bytes a second; None while the path is unknown."""
        return None if self._rtt is None else PACING_GAIN * self._window / max(self._rtt.smoothed, 1e-4)

    def take_policed(self) -> bool:
        """Return False: a policer's losses are congestion like others."""
        return False

    # -- inputs ---------------------------------------------------------------------------------------------------

    def on_sent(self, now: float, size: int, in_flight: int) -> None:
        """See `CongestionController`."""
        self._probe_credit = 0
        if in_flight <= size:
            self._heard_at = now
        pace = self.pacing_rate
        if pace is not None:
            # A leaky bucket: after a pause a burst of the initial window may leave.
            self._release_at = max(self._release_at, now - INITIAL_WINDOW_BYTES / pace) + size / pace

    def ran_dry(self) -> None:
        """See `CongestionController`."""
        self._underused = True

    def on_acked(self, sample: RateSample, rtt: RttEstimator, now: float) -> None:
        """Grow by what arrived: as much in slow start, a datagram for each window later."""
        self._rtt = rtt
        self._heard_at = now
        if self._underused or sample.sent_at <= self._recovery_since:
            return  # RFC 9002 section 7.8: a window that was not used up was not shown to fit
        if self._window < self._threshold:
            grown = self._window + sample.acked_bytes
        else:
            grown = self._window + DATAGRAM_BYTES * sample.acked_bytes / self._window
        self._window = min(grown, float(MAX_WINDOW_BYTES))

    def on_lost(self, lost_bytes: int, sent_at: float, in_flight: int, now: float) -> None:
        """Halve the window, once in a round trip."""
        if sent_at > self._recovery_since:
            self._begin_recovery(now)

    def on_spurious(self, size: int) -> None:
        """Do nothing: RFC 9002 restores no window."""

    def on_probe_timeout(self, now: float) -> None:
        """See `CongestionController`; after a long silence, start from the minimum (RFC 9002 section 7.6.2)."""
        self._probe_credit = 2 * DATAGRAM_BYTES
        rtt = self._rtt
        if rtt is None or now - self._heard_at <= rtt.persistent_congestion(END_HOST_S):
            return
        if self._window > MIN_WINDOW_BYTES:
            self._begin_recovery(now)
            self._window = float(MIN_WINDOW_BYTES)

    def on_path_down(self) -> None:
        """Start again with at most the initial window, as after a pause (RFC 5681 section 4.1)."""
        self._window = min(self._window, float(INITIAL_WINDOW_BYTES))

    def on_path_up(self, now: float) -> None:
        """Do nothing: the window is that of a pause."""

    def _begin_recovery(self, now: float) -> None:
        self._recovery_since = now
        self._window = self._threshold = max(LOSS_REDUCTION * self._window, float(MIN_WINDOW_BYTES))
