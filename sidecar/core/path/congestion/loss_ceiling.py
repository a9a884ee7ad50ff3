"""Puts a ceiling on the bytes in flight of one path, cut by losses that mean congestion.

Radio links lose datagrams without being full, so a loss alone says nothing. Congestion is a loss while a queue stands,
if such losses are clearly more frequent than those without one. If there are hardly any without one, it is a single
loss that met a full queue. Heavy loss means congestion in any case. The ceiling then falls and grows again as CUBIC's
window does (RFC 9438), so that TCP at the same bottleneck keeps its share.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.sidecar.core.path.congestion.standing_queue import FloorChange, StandingQueue
from plr.sidecar.core.path.congestion.units import DATAGRAM_BYTES

if TYPE_CHECKING:
    from plr.sidecar.core.path.congestion.rtt import RttEstimator

CUT = 0.7
"""Share that a cut leaves (CUBIC's beta, RFC 9438 section 4.6)."""
CUBIC_C = 0.4
"""Growth, datagrams per cubed second (RFC 9438 section 5)."""
LEAST_BYTES = 4 * DATAGRAM_BYTES
SIGNIFICANT = 2.0
"""A queue's losses are congestion if they are this many times as frequent as those without a queue."""
UNUSUAL = 0.005
"""If less than this share is lost without a queue, a single loss is congestion if it met a full queue. With more, the
occasional losses of a radio would cut again and again whenever the route becomes longer for a while."""
MEMORY_BYTES = 500 * DATAGRAM_BYTES
"""Bytes over which the frequency of losses without a queue is measured."""
MEMORY_S = 10.0
"""... and how long it holds where a queue always stands: if it was wrong, that queue's losses would pass for usual."""
HEAVY_LOSS = 0.2
HEAVY_BYTES = 8 * DATAGRAM_BYTES
"""Losing this share and this much of what was recently sent is congestion even without a queue: a policer, a tiny
buffer. Recent is a window, not the round: on a busy host one acknowledgement first says that most of a window arrived,
which ends a round, and then what is missing from it."""
PATIENCE_ROUNDS = 20
PATIENCE_S = 1.0
"""A ceiling that a queue's losses set is left alone for this long: others that also yielded come back by then."""
RECENT_BYTES = 64 * DATAGRAM_BYTES
"""Least number of bytes that counts as recent."""
REGAIN = 1.25
"""A ceiling that binds grows by this factor with each round that neither met a queue nor lost more than usual. It need
not find where the path ends: the model of the path, whose rate is what was delivered, does that."""


class LossCeiling:
    """Bytes that may be in flight; None while nothing was lost to congestion."""

    __slots__ = (
        "_acked",
        "_at",
        "_lost",
        "_most_before",
        "_most_in_flight",
        "_queue",
        "_queue_before",
        "_queue_cut",
        "_queued",
        "_recent",
        "_recent_lost",
        "_regained_at",
        "_start",
        "_top",
        "_unclear",
        "_usual_at",
        "_usual_bytes",
        "_usual_lost",
        "bytes",
    )

    def __init__(self) -> None:
        self.bytes: float | None = None
        self._at = float("-inf")
        """When the last cut was."""
        self._start = 0.0
        self._top = 0.0
        self._acked = self._lost = 0
        """Bytes of this round."""
        self._most_in_flight = self._most_before = 0
        self._recent = self._recent_lost = 0.0
        self._regained_at = 0.0
        self._queue_cut = False
        """Whether the last cut was for losses while a queue stood."""
        self._queued = False
        self._queue_before = False
        self._unclear = True
        """Whether this round's losses say nothing of the usual loss: because of a cut for them, or because it is the
        first round, which sends a burst into an unknown path."""
        self._usual_bytes = 0.0
        self._usual_lost = 0.0
        self._usual_at = 0.0
        """When these two were last added to."""
        self._queue = StandingQueue()

    def on_sent(self, in_flight: int) -> None:
        """Note the bytes in flight."""
        self._most_in_flight = max(self._most_in_flight, in_flight)

    def on_acked(self, size: int, rtt_s: float, rtt: RttEstimator, wanted: float, now: float) -> None:
        """Grow. `wanted` is the window without a ceiling; a ceiling far above it is forgotten."""
        self._acked += size
        self._note_recent(size)
        if rtt_s:
            change = self._queue.note(rtt_s, rtt, now)
            if change is FloorChange.FELL:
                self._usual_bytes = self._usual_lost = 0.0  # learned while others' queue counted as none
            elif change is FloorChange.ROSE and self._queue_cut:
                self.forget()
                self._queued = self._queue_before = False
            self._queued |= self._queue.is_met_by(rtt_s, rtt)
        if self.bytes is not None:
            self.bytes = self._grown(now - self._at, rtt.smoothed)
            if self.bytes > 2 * max(wanted, self._top):
                self.forget()

    def on_lost(self, size: int, sent_at: float, in_flight: int, rtt: RttEstimator, now: float) -> bool:
        """Take a loss, the newest datagram of it sent at `sent_at`; return True if it cut the ceiling."""
        self._lost += size
        self._note_recent(size)
        self._recent_lost += size
        if sent_at <= self._at:
            return False  # it left before the last cut could help (RFC 9002 section 7.3.2)
        queue = self._queue.stands(rtt) and self._is_unusual(full=self._queue.is_full(rtt))
        if not queue and not self._is_heavy():
            return False
        self._unclear = True
        self._queue_cut = queue
        before = float(max(in_flight + size, self._most_in_flight))
        if self.bytes is not None:
            before = min(before, self.bytes)
        # Fast convergence (RFC 9438 section 4.7): a flow that yields twice leaves room for others.
        self._top = before if before >= self._top else before * (1 + CUT) / 2
        self._start = self.bytes = max(CUT * before, LEAST_BYTES)
        self._at = now
        self._recent_lost = 0.0
        if queue:
            self._queue.on_cut(rtt, now)
        return True

    def meets_queue(self, rtt: RttEstimator) -> bool:
        """Return whether what is lost now may have met a queue."""
        return self._queued or self._queue_before or self._queue.stands(rtt)

    def end_round(self, rtt: RttEstimator, now: float) -> None:
        """End a round trip. Its loss is usual if no datagram met a queue in it, nor in the one before."""
        if not self._queued and not self._queue_before and not self._unclear and not self._is_heavy():
            self._regain(rtt, now)
            self._usual_at = now
            if self._usual_bytes > MEMORY_BYTES:
                self._usual_bytes /= 2
                self._usual_lost /= 2
            self._usual_bytes += self._acked + self._lost
            self._usual_lost += self._lost
        elif now - self._usual_at > MEMORY_S:
            self._usual_bytes = self._usual_lost = 0.0
        self._queue_before = self._queued
        self._queued = self._unclear = False
        self._acked = self._lost = 0
        self._most_before, self._most_in_flight = self._most_in_flight, 0

    def _regain(self, rtt: RttEstimator, now: float) -> None:
        binds = self.bytes is not None and max(self._most_in_flight, self._most_before) >= self.bytes / 2
        if self.bytes is None or not binds or now - max(self._at, self._regained_at) < rtt.smoothed:
            return
        if self._queue_cut and now - self._at < max(PATIENCE_ROUNDS * rtt.smoothed, PATIENCE_S):
            return
        self._regained_at = now
        self._start = self.bytes = REGAIN * self.bytes

    def _note_recent(self, size: int) -> None:
        """Make room for these bytes among the recent ones."""
        keep = max(self._most_in_flight, self._most_before, RECENT_BYTES) - size
        if self._recent > keep:
            self._recent_lost *= max(keep, 0) / self._recent
            self._recent = max(keep, 0)
        self._recent += size

    def forget(self) -> None:
        """Remove the ceiling."""
        self.bytes = None
        self._top = 0.0
        self._at = float("-inf")

    def _grown(self, elapsed_s: float, rtt_s: float) -> float:
        top, start = self._top / DATAGRAM_BYTES, self._start / DATAGRAM_BYTES
        plateau_s: float = (max(0.0, top - start) / CUBIC_C) ** (1 / 3)
        cubic = CUBIC_C * (elapsed_s - plateau_s) ** 3 + top
        # Not slower than Reno (RFC 9438 section 4.3).
        reno = start + 3 * (1 - CUT) / (1 + CUT) * elapsed_s / max(rtt_s, 0.001)
        return float(max(cubic, reno, start)) * DATAGRAM_BYTES

    def _is_heavy(self) -> bool:
        return self._recent_lost > max(HEAVY_LOSS * self._recent, HEAVY_BYTES)

    def _is_unusual(self, *, full: bool) -> bool:
        """Return whether recent loss exceeds the loss without a queue; `full`: the last loss met a full one."""
        if full and self._usual_lost <= UNUSUAL * self._usual_bytes:
            return True
        usual = self._usual_lost / max(self._usual_bytes, self._recent) * self._recent
        return self._recent_lost > SIGNIFICANT * (usual + DATAGRAM_BYTES)
