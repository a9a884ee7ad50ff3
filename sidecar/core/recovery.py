"""Datagrams in flight on one path: acknowledgement, loss detection, probe timeout (terms of RFC 9002)."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from sidecar.core.congestion import RateSample
from sidecar.core.received import MAX_ACK_DELAY_S
from sidecar.core.rtt import RttEstimator

if TYPE_CHECKING:
    from sidecar.core.frame import AckFrame
    from sidecar.core.outbound import OutboundMessage

PACKET_THRESHOLD = 3
"""A datagram is lost when one sent this many later is acknowledged (RFC 9002 section 6.1.1)."""
PTO_DATAGRAMS = 2
"""How many of the oldest datagrams a probe timeout gives up (RFC 9002 section 6.2.4 allows two probes)."""
MAX_PTO_BACKOFF = 6
"""Probe timeouts stop doubling here; the path is long down by then."""


class Sent(NamedTuple):
    """An ack-eliciting datagram in flight."""

    at: float
    size: int
    delivered: int
    """Bytes acknowledged on the path when it left (for the delivery rate)."""
    fragment: tuple[OutboundMessage, int] | None
    """The message and index of the symbol it carries."""
    finished: int | None
    """The message it reports FINISHED."""


class Recovery:
    """Sender's side of one path's packet number space."""

    __slots__ = (
        "_lost_at",
        "_next_number",
        "_pto_count",
        "acked_bytes",
        "in_flight",
        "largest_acked",
        "last_eliciting_at",
        "rtt",
        "sample",
        "sent",
        "total_lost",
        "total_sent",
    )

    def __init__(self, first_number: int) -> None:
        self.rtt = RttEstimator()
        self.sent: dict[int, Sent] = {}
        self.sample: RateSample | None = None
        """What the last acknowledgement says of the path's rate; None when it acknowledged no fragment."""
        self.in_flight = 0
        self.acked_bytes = 0
        self.largest_acked = first_number - 1
        self.last_eliciting_at = 0.0
        self.total_sent = 0
        self.total_lost = 0
        self._next_number = first_number
        self._lost_at: float | None = None
        self._pto_count = 0

    @property
    def next_number(self) -> int:
        """The packet number that comes next."""
        return self._next_number

    def take_number(self) -> int:
        """Return the packet number of the next datagram."""
        number = self._next_number
        self._next_number += 1
        self.total_sent += 1
        return number

    def on_sent(
        self,
        number: int,
        now: float,
        size: int,
        fragment: tuple[OutboundMessage, int] | None = None,
        finished: int | None = None,
    ) -> None:
        """An ack-eliciting datagram left."""
        self.sent[number] = Sent(now, size, self.acked_bytes, fragment, finished)
        self.in_flight += size
        self.last_eliciting_at = now

    def on_ack(self, ack: AckFrame, now: float) -> list[Sent] | None:
        """Take an acknowledgement and return what it newly acknowledges; None when it acknowledges the unsent."""
        largest = ack.ranges[0][1]
        if largest >= self._next_number:
            return None
        sent = self.sent
        newly: list[Sent] = []
        newest: Sent | None = sent.get(largest)
        oldest = next(iter(sent), self._next_number)
        for low, high in ack.ranges:
            if high < oldest:
                break
            # From the oldest in flight on: what a peer repeats or makes up below it costs nothing.
            for number in range(max(low, oldest), high + 1):
                datagram = sent.pop(number, None)
                if datagram is not None:
                    self.in_flight -= datagram.size
                    self.acked_bytes += datagram.size
                    newly.append(datagram)
        self.sample = None
        carried = [datagram for datagram in newly if datagram.fragment is not None]
        if carried:
            sent_at = max(datagram.at for datagram in carried)
            size = sum(datagram.size for datagram in carried)
            self.sample = RateSample(size, sent_at, now - sent_at if newest is not None else 0.0, self.in_flight)
        if newest is not None:
            self.rtt.sample(now - newest.at, now, ack.delay_s)
        if newly:
            self._pto_count = 0
            self.largest_acked = max(self.largest_acked, largest)
        return newly

    def detect_lost(self, now: float) -> list[Sent]:
        """Return what packet and time threshold call lost by now, and arm the time threshold for the rest."""
        self._lost_at = None
        delay = self.rtt.loss_delay()
        lost: list[int] = []
        for number, datagram in self.sent.items():
            if number > self.largest_acked:
                break
            if self.largest_acked - number >= PACKET_THRESHOLD or datagram.at + delay <= now:
                lost.append(number)
            else:
                self._lost_at = datagram.at + delay
                break
        return [self._forget(number) for number in lost]

    def on_probe_timeout(self, now: float) -> list[Sent]:
        """The probe timeout passed: give up the oldest datagrams so that their content travels again."""
        self._pto_count = min(self._pto_count + 1, MAX_PTO_BACKOFF)
        self.last_eliciting_at = now
        oldest = list(self.sent)[:PTO_DATAGRAMS]
        return [self._forget(number) for number in oldest]

    def give_up_all(self) -> list[Sent]:
        """The path is dead: everything in flight counts as lost."""
        return [self._forget(number) for number in list(self.sent)]

    def _forget(self, number: int) -> Sent:
        datagram = self.sent.pop(number)
        self.in_flight -= datagram.size
        self.total_lost += 1
        return datagram

    @property
    def loss_timer(self) -> float | None:
        """When `detect_lost` has something to find without a further acknowledgement."""
        return self._lost_at

    @property
    def pto_timer(self) -> float | None:
        """When an acknowledgement is overdue; None when nothing is in flight."""
        if not self.sent:
            return None
        timeout = self.rtt.probe_timeout(MAX_ACK_DELAY_S) * (1 << self._pto_count)
        return self.last_eliciting_at + timeout
