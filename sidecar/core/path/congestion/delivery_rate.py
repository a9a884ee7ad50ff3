"""Estimates the rate at which one path delivers, from the spacing of acknowledgements.

It measures trains: datagrams sent one after the other without a pause for lack of data. A train is cut into rounds of
at least a round trip. The rate of a round is the bytes acknowledged in it over the time this took, or over the time the
sender took, whichever is longer (after draft-cheng-iccrg-delivery-rate-estimation, without state per datagram). A pause
between two requests belongs to no train, so a burst of a few datagrams measures the path and not the application.
"""

from __future__ import annotations

from collections import deque

MIN_ROUND_BYTES = 8 * 1200
"""A rate of fewer bytes is noise."""
LIMITED_FACTOR = 1.5
"""Acknowledgements this much further apart than what they acknowledge show the path's rate, not the sender's. A smaller
factor may come from a host that was slow to wake."""
ROUNDS = 10
"""The best of this many rounds counts (BBR's filter)."""
BELIEVED_ROUNDS = 2
"""Rounds that remain when they contradict a standing queue."""
MAX_TRAINS = 256
"""Trains under way; beyond that, the oldest ones count as one."""
CONFIRMS = 0.5
"""A train at this share of the rate confirms it: trains are paced, in some rounds at three quarters of the rate."""
PROVES_BYTES = 2 * MIN_ROUND_BYTES
"""Bytes whose spacing confirms a rate, or replaces one that nothing confirmed for long."""
FRESH_S = 3.0
"""A rate is relied upon for this long after it was last confirmed."""


class DeliveryRate:
    """Best delivery rate of the last rounds, bytes a second; 0 while unknown."""

    __slots__ = (
        "_anchor_at",
        "_anchor_sent_at",
        "_bytes",
        "_limited",
        "_rate",
        "_rounds",
        "_trains",
        "best",
        "confirmed_at",
        "is_dry",
        "limited_by_sender",
        "settled",
    )

    def __init__(self) -> None:
        self.best = 0.0
        self.settled = 0.0
        """The best of complete rounds, without the current one."""
        self.limited_by_sender = True
        """Whether the last complete round shows no more than what was offered."""
        self._rounds: deque[float] = deque(maxlen=ROUNDS)
        self._trains: deque[float] = deque()
        self.is_dry = True
        """Whether the next datagram begins a train."""
        self.confirmed_at = float("-inf")
        """When a train last reached about the best rate (s)."""
        self._anchor_at: float | None = None
        self._anchor_sent_at = 0.0
        self._bytes = 0
        self._rate = 0.0
        self._limited = True

    def on_sent(self, now: float) -> None:
        """Note that something left."""
        if self.is_dry:
            self.is_dry = False
            if len(self._trains) >= MAX_TRAINS:
                self._trains.popleft()
            self._trains.append(now)

    def ran_dry(self) -> None:
        """Note that nothing waits to be sent: the next datagram begins a train."""
        self.is_dry = True

    def on_acked(self, size: int, sent_at: float, now: float, limit: float, *, held_back: bool = False) -> bool:
        """Take newly acknowledged bytes, the newest of them sent at `sent_at`; return True if that ended a round.

        A round in which the controller held back says as little against a better one as a round for lack of data. No
        round is believed beyond `limit`: acknowledgements that come in clumps may show any rate.
        """
        trains = self._trains
        begins = self._anchor_at is None
        while len(trains) > 1 and sent_at >= trains[1]:
            trains.popleft()
            begins = True
        if begins:
            over = self._close(sender=True)
            self._anchor(now, sent_at)
            return over
        assert self._anchor_at is not None
        self._bytes += size
        acked_s, sent_s = now - self._anchor_at, sent_at - self._anchor_sent_at
        self._confirm(now, acked_s, sent_s, limit)
        if self._bytes >= MIN_ROUND_BYTES and acked_s > 0:
            self._rate = min(self._bytes / max(acked_s, sent_s), limit)
            self._limited = acked_s <= LIMITED_FACTOR * sent_s
            self._update()
            if sent_at >= self._anchor_at:
                self._close(sender=held_back)
                self._anchor(now, sent_at)
                return True
        return False

    def _confirm(self, now: float, acked_s: float, sent_s: float, limit: float) -> None:
        """Let the train so far confirm the best rate, or replace one that nothing confirmed for long."""
        if self._bytes < PROVES_BYTES:
            return
        rate = min(self._bytes / max(acked_s, sent_s, 1e-9), limit)
        if rate >= CONFIRMS * self.settled or acked_s <= LIMITED_FACTOR * sent_s:
            self.confirmed_at = now  # as fast as ever, or as fast as it was sent
        elif not self.is_confirmed(now):
            self._rounds.clear()
            self._rounds.append(rate)
            self.confirmed_at = now

    def _anchor(self, now: float, sent_at: float) -> None:
        self._anchor_at = now
        self._anchor_sent_at = sent_at
        self._bytes = 0
        self._rate = 0.0
        self._limited = True

    def is_confirmed(self, now: float) -> bool:
        """Return whether the best rate may be relied upon: the path may have changed since it was confirmed."""
        return now - self.confirmed_at <= FRESH_S

    def _close(self, *, sender: bool) -> bool:
        """End the round; `sender`: for lack of data. A round that the sender limited can only raise the rate."""
        rate = self._rate
        if not rate:
            return False
        self.limited_by_sender = sender and self._limited
        if not self.limited_by_sender:
            self._rounds.append(rate)
        elif rate > self.settled:
            if self._rounds:
                self._rounds[-1] = rate
            else:
                self._rounds.append(rate)
        self._rate = 0.0
        self._update()
        return True

    def _update(self) -> None:
        self.settled = max(self._rounds, default=0.0)
        self.best = max(self.settled, self._rate)

    def believe_latest(self) -> None:
        """Forget all but the latest rounds: a standing queue shows that the others were too high."""
        while len(self._rounds) > BELIEVED_ROUNDS:
            self._rounds.popleft()
        self._update()

    def restart(self, rate: float) -> None:
        """Start over with this rate."""
        self._rounds.clear()
        if rate:
            self._rounds.append(rate)
        self._trains.clear()
        self.is_dry = True
        self._anchor_at = None
        self._rate = 0.0
        self._update()
