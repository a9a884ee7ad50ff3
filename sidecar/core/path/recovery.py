"""Tracks the datagrams in flight on one path: acknowledgement, loss detection, probe timeout (terms of RFC 9002)."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from operator import attrgetter
from typing import TYPE_CHECKING

from plr.sidecar.core.path.congestion.controller import RateSample
from plr.sidecar.core.path.congestion.rtt import RttEstimator
from plr.sidecar.core.path.in_flight import Sent
from plr.sidecar.core.path.received import MAX_ACK_DELAY_S
from plr.sidecar.core.path.reordering import Reordering

if TYPE_CHECKING:
    import random

    from plr.sidecar.core.message.symbols import MessageSymbols
    from plr.sidecar.core.wire.frame import AckFrame

PTO_DATAGRAMS = 2
"""Number of the oldest datagrams that a probe timeout gives up (RFC 9002 section 6.2.4 allows two probes)."""
FIRST_SKIP, MAX_SKIP = 128, 1 << 17
"""Among the first FIRST_SKIP datagrams a packet number is skipped, then among twice as many, up to MAX_SKIP. A peer
that acknowledges what never came, to be sent more than its path carries, names a skipped one (RFC 9000 section 21.4).
"""
MAX_SKIPPED = 16
"""Skipped numbers that are remembered, the newest."""
MAX_PTO_BACKOFF = 6
"""Doublings after which probe timeouts stop growing. They also stop at the longest wait on this path, or at the time an
answer takes."""

_first = attrgetter("first")


class Recovery:
    """Sender's side of one path's packet number space."""

    __slots__ = (
        "_lost_at",
        "_next_number",
        "_pto_count",
        "_rng",
        "_skip_at",
        "_skip_every",
        "_skipped",
        "in_flight",
        "largest_acked",
        "last_eliciting_at",
        "reordering",
        "rtt",
        "sample",
        "sent",
        "total_arrived",
        "total_lost",
        "total_sent",
    )

    def __init__(self, first_number: int, rng: random.Random | None = None) -> None:
        """Create the state; without `rng` no packet number is skipped."""
        self.rtt = RttEstimator()
        self.reordering = Reordering()
        self.sent: list[Sent] = []
        """In the order of packet numbers."""
        self.sample: RateSample | None = None
        """The last acknowledgement's sample of the path's rate; None if it acknowledged no fragment."""
        self.in_flight = 0
        self.largest_acked = first_number - 1
        self.last_eliciting_at = 0.0
        self.total_sent = 0
        self.total_lost = 0
        self.total_arrived = 0
        """Acknowledged datagrams, among those that elicit an ack."""
        self._next_number = first_number
        self._rng = rng
        self._skip_every = FIRST_SKIP
        self._skipped: deque[int] = deque(maxlen=MAX_SKIPPED)
        """Recently skipped packet numbers."""
        self._skip_at = self._next_skip() if rng is not None else math.inf
        self._lost_at: float | None = None
        self._pto_count = 0

    def forget_rtt(self) -> None:
        """Measure the round trip from the beginning: the route changed."""
        self.rtt = RttEstimator()

    @property
    def next_number(self) -> int:
        """The next packet number."""
        return self._next_number

    def take_numbers(self, count: int = 1) -> int:
        """Take the packet numbers of the next `count` datagrams and return the first."""
        if self._next_number + count > self._skip_at:
            self._skipped.append(self._next_number)
            self._next_number += 1
            self._skip_every = min(2 * self._skip_every, MAX_SKIP)
            self._skip_at = self._next_skip()
        number = self._next_number
        self._next_number += count
        self.total_sent += count
        return number

    def _next_skip(self) -> float:
        assert self._rng is not None
        return self._next_number + self._rng.randrange(self._skip_every // 2, self._skip_every) + 1

    def on_run_sent(
        self,
        first: int,
        count: int,
        now: float,
        segment: int,
        last: int,
        message: MessageSymbols,
        index: int,
        finished: tuple[int, ...] = (),
    ) -> None:
        """Note datagrams that carry the symbols of `message` from `index` on, one each; sizes as in `Sent`.

        A single datagram may also report messages FINISHED.
        """
        self._note(Sent(first, count, now, segment, last, message, index, finished))

    def on_finished_sent(self, number: int, now: float, size: int, finished: tuple[int, ...]) -> None:
        """Note a datagram that reports these messages FINISHED."""
        self._note(Sent(number, 1, now, size, size, finished=finished))

    def _note(self, sent: Sent) -> None:
        self.sent.append(sent)
        self.in_flight += sent.size
        self.last_eliciting_at = sent.at

    def on_ack(self, ack: AckFrame, now: float) -> list[Sent] | None:
        """Take an acknowledgement and return what it newly acknowledges; None if it acknowledges what was never sent.

        An honest peer never does that.
        """
        largest = ack.ranges[0][1]
        if largest >= self._next_number:
            return None
        if any(low <= skipped <= high for skipped in self._skipped for low, high in ack.ranges):
            return None
        newly: list[Sent] = []
        for low, high in ack.ranges:
            # Start at the oldest in flight: what a peer repeats or makes up below it costs nothing.
            if not self.sent or high < self.sent[0].first:
                break
            self._acknowledge(low, high, newly)
        self.sample = None
        if newly:
            self.total_arrived += sum(run.datagrams for run in newly)
            self._measure(newly, largest, ack.delay_s, now)
            self._pto_count = 0
            self.largest_acked = max(self.largest_acked, largest)
        return newly

    def _acknowledge(self, low: int, high: int, newly: list[Sent]) -> None:
        """Move what the inclusive range covers from `sent` to `newly`; keep the rest of the runs it cuts."""
        runs = self.sent
        start = bisect_right(runs, low, key=_first)
        if start and runs[start - 1].end > low:
            start -= 1
        end = start
        rest: list[Sent] = []
        while end < len(runs) and runs[end].first <= high:
            run = runs[end]
            end += 1
            if run.first < low:
                rest.append(run.cut(run.first, low))
            if run.end > high + 1:
                rest.append(run.cut(high + 1, run.end))
            part = run.cut(max(low, run.first), min(high + 1, run.end))
            self.in_flight -= part.size
            newly.append(part)
        runs[start:end] = rest

    def _measure(self, newly: list[Sent], largest: int, peer_delay_s: float, now: float) -> None:
        newest_at = next((run.at for run in newly if run.end == largest + 1), None)
        carried = [run for run in newly if run.message is not None]
        if carried:
            sent_at = max(run.at for run in carried)
            size = sum(run.size for run in carried)
            self.sample = RateSample(size, sent_at, now - sent_at if newest_at is not None else 0.0, self.in_flight)
        if newest_at is not None:
            self.rtt.sample(now - newest_at, now, peer_delay_s)

    def late(self, ack: AckFrame, now: float) -> list[Sent]:
        """Return what an acknowledgement covers although it was declared lost."""
        arrived = self.reordering.late(ack.ranges, self.rtt, now)
        if arrived:
            # Where every answer takes longer than the timeouts, only these show how long.
            self._pto_count = 0
            newest_at = next((run.at for run in arrived if run.end == ack.ranges[0][1] + 1), None)
            if newest_at is not None:
                self.rtt.sample(now - newest_at, now, ack.delay_s)
        self.reordering.overtaken(self.largest_acked)
        return arrived

    def detect_lost(self, now: float) -> list[Sent]:
        """Return what the packet and time thresholds declare lost by now, and arm the time threshold for the rest."""
        self._lost_at = None
        delay = self.reordering.loss_delay(self.rtt)
        threshold = self.reordering.packet_threshold
        overtaken = self.largest_acked - threshold if threshold is not None else -1
        lost: list[Sent] = []
        whole = 0
        for run in self.sent:
            if run.first > self.largest_acked:
                break
            if run.at + delay > now and run.end - 1 > overtaken:
                if run.first <= overtaken:
                    lost.append(run.cut(run.first, overtaken + 1))
                    self.sent[whole] = run.cut(overtaken + 1, run.end)
                self._lost_at = run.at + delay
                break
            lost.append(run)
            whole += 1
        del self.sent[:whole]
        return self._lose(lost, by_threshold=True)

    def on_probe_timeout(self, now: float) -> list[Sent]:
        """Give up the oldest datagrams after a probe timeout, so that their content travels again."""
        self._pto_count = min(self._pto_count + 1, MAX_PTO_BACKOFF)
        self.last_eliciting_at = now
        lost: list[Sent] = []
        left = PTO_DATAGRAMS
        while self.sent and left:
            run = self.sent[0]
            part = run.cut(run.first, run.first + min(left, run.datagrams))
            self.sent[:1] = [run.cut(part.end, run.end)] if part.end < run.end else []
            left -= part.datagrams
            lost.append(part)
        return self._lose(lost, by_threshold=False)

    def ask_at_once(self, now: float) -> None:
        """Make the probe timeout due now: the path answers again, but not about what is in flight."""
        self._pto_count = 0
        self.last_eliciting_at = now - self._longest_timeout()

    def give_up_all(self, *, forget: bool) -> list[Sent]:
        """Declare everything in flight lost because the path is dead.

        With `forget`, a later acknowledgement of it proves nothing.
        """
        lost, self.sent = self.sent, []
        self._lost_at = None
        if forget:
            self.reordering.forget()
        else:
            self.reordering.note_given_up(lost)
        return self._forget(lost)

    def _lose(self, lost: list[Sent], *, by_threshold: bool) -> list[Sent]:
        if lost:
            self.reordering.note_lost(lost, by_threshold=by_threshold)
        return self._forget(lost)

    def _forget(self, lost: list[Sent]) -> list[Sent]:
        for run in lost:
            self.in_flight -= run.size
            self.total_lost += run.datagrams
        return lost

    @property
    def loss_timer(self) -> float | None:
        """When `detect_lost` finds something without a further acknowledgement."""
        return self._lost_at

    @property
    def pto_timer(self) -> float | None:
        """When an acknowledgement is overdue; None when nothing is in flight."""
        if not self.sent:
            return None
        timeout = self.rtt.probe_timeout(MAX_ACK_DELAY_S) * (1 << self._pto_count)
        return self.last_eliciting_at + min(timeout, self._longest_timeout())

    def _longest_timeout(self) -> float:
        return max(self.rtt.longest_wait(), self.rtt.next_answer())
