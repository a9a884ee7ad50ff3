"""Estimates the round-trip time of one path (RFC 9002 section 5; RFC 6298)."""

from __future__ import annotations

INITIAL_RTT_S = 0.2
"""Assumed before the first sample: a cellular path at rest."""
GRANULARITY_S = 0.001
"""Finest timer that is worth arming."""
UNSTABLE_FLOOR_S = 0.060
"""A path silent for less than this never counts as unstable (SRT's floor)."""
LONGEST_WAIT_S = 1.0
"""Longest wait for a sign of life beyond two bare round trips. A queue makes the round trip long, but its datagrams
still arrive one after the other; if none does for this long, the path is dead or as good as dead. What left before an
outage and arrives after it makes a round trip that says nothing of the path."""
LONGEST_ANSWER_S = 15.0
"""An answer counts for this long after its question left: longer than the longest round trip that has to work (10 s),
by what both ends may add to it. Older ones would only say that the path lived once."""
MINIMUM_MEMORY_S = 10.0
"""A minimum not seen again for this long is forgotten: the route may have become longer (BBR's RTprop filter)."""

PERSISTENT_FACTOR = 3
"""Probe timeouts without any acknowledgement that make congestion persistent (RFC 9002 section 7.6.1)."""


class RttEstimator:
    """Smoothed round-trip time, its variation and its recent minimum, in seconds."""

    __slots__ = ("_half_began", "_half_minimum", "_last_minimum", "latest", "minimum", "smoothed", "variation")

    def __init__(self) -> None:
        self.smoothed = 0.0
        self.variation = 0.0
        self.minimum = 0.0
        """The minimum of the last MINIMUM_MEMORY_S, give or take half."""
        self.latest = 0.0
        self._half_began = 0.0
        self._half_minimum = 0.0
        self._last_minimum = 0.0

    @property
    def has_sample(self) -> bool:
        """Whether anything was measured."""
        return self.latest > 0

    def sample(self, rtt_s: float, now: float, peer_delay_s: float = 0.0) -> None:
        """Take one measured round trip, of which the peer claims `peer_delay_s` as its own delay.

        The claim counts only if it leaves a possible round trip (RFC 9002 section 5.3).
        """
        rtt_s = max(rtt_s, 1e-6)
        if not self.has_sample:
            self.latest = self.smoothed = rtt_s
            self.variation = rtt_s / 2
            self.restart_minimum(rtt_s, now)
            return
        self._note_minimum(rtt_s, now)
        if rtt_s - peer_delay_s >= self.minimum:
            rtt_s -= peer_delay_s
        self.variation += (abs(self.smoothed - rtt_s) - self.variation) / 4
        self.smoothed += (rtt_s - self.smoothed) / 8
        self.latest = rtt_s

    def _note_minimum(self, rtt_s: float, now: float) -> None:
        """Keep the minimum of this half of the memory and of the previous half."""
        if now - self._half_began >= MINIMUM_MEMORY_S / 2:
            stale = now - self._half_began >= MINIMUM_MEMORY_S
            self._last_minimum = rtt_s if stale else self._half_minimum
            self._half_minimum = rtt_s
            self._half_began = now
        elif rtt_s < self._half_minimum:
            self._half_minimum = rtt_s
        self.minimum = min(self._half_minimum, self._last_minimum)

    def restart_minimum(self, minimum_s: float, now: float) -> None:
        """Replace the minimum by the path's current round trip without a queue of ours."""
        self.minimum = self._half_minimum = self._last_minimum = minimum_s
        self._half_began = now

    def probe_timeout(self, peer_delay_s: float) -> float:
        """Return the seconds after which an acknowledgement is overdue (RFC 9002 section 6.2.1)."""
        if not self.has_sample:
            return 2 * INITIAL_RTT_S
        return self.smoothed + max(4 * self.variation, GRANULARITY_S) + peer_delay_s

    def persistent_congestion(self, peer_delay_s: float) -> float:
        """Return the seconds of silence that make congestion persistent (RFC 9002 section 7.6.1)."""
        return PERSISTENT_FACTOR * self.probe_timeout(peer_delay_s)

    def loss_delay(self) -> float:
        """Return the seconds after which a datagram older than an acknowledged one is lost (RFC 9002 section 6.1.2)."""
        reference = max(self.smoothed, self.latest) if self.has_sample else INITIAL_RTT_S
        return max(9 / 8 * reference, GRANULARITY_S)

    def silence_limit(self) -> float:
        """Return the seconds of unanswered silence after which the path is unstable."""
        if not self.has_sample:
            return 2 * INITIAL_RTT_S
        return max(min(2 * self.smoothed + 4 * self.variation, self.longest_wait()), UNSTABLE_FLOOR_S)

    def next_answer(self) -> float:
        """Return in how many seconds the answer to what leaves now should come, if little slower than the last."""
        return self.latest + min(self.latest / 4, LONGEST_WAIT_S)

    def longest_wait(self) -> float:
        """Return the seconds after which anything awaited on a living path should have come, whatever the queue."""
        return LONGEST_WAIT_S + 2 * min(self.minimum, LONGEST_WAIT_S)
