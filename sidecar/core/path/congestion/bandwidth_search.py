"""Finds out whether a path carries more: by doubling at first, then by sending a quarter more now and then.

Rates in bytes a second, times in seconds. After BBR's Startup and ProbeBW (draft-ietf-ccwg-bbr sections 5.3.1, 5.3.3).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.sidecar.core.path.congestion.units import DATAGRAM_BYTES, END_HOST_S

if TYPE_CHECKING:
    from plr.sidecar.core.path.congestion.delivery_rate import DeliveryRate

CYCLE = (1.25, 0.75, 1.0, 1.0)
"""Pacing gains round by round: send more, drain what that queued, cruise (after BBR's ProbeBW, whose cycle has twice as
many rounds: radio links change their rate within a second)."""
CRUISING = 2
"""Position in the cycle at which a path begins whose rate was just found."""
PROBE_GROWTH = 1.1
"""Growth of the rate that makes the path search again at once."""
FULL_GROWTH = 1.25
FULL_ROUNDS = 3
"""The path is full when the rate did not grow by FULL_GROWTH within FULL_ROUNDS ..."""
QUEUED_ROUNDS = 2
"""... or when a queue stands for this many: in a single round, all may have waited for a busy host's thread."""


class BandwidthSearch:
    """The search for more bandwidth, fed with every round of start-up (`is_full`) and of cruising (`finds_more`)."""

    __slots__ = ("_cycle", "_full_rate", "_full_rounds", "_queued_rounds", "_rate_before")

    def __init__(self) -> None:
        self._cycle = CRUISING
        self._rate_before = 0.0
        self._full_rate = 0.0
        self._full_rounds = 0
        self._queued_rounds = 0

    # -- doubling -------------------------------------------------------------------------------------------------

    def restart(self) -> None:
        """Begin doubling: the path may carry any number of times more, and is full when doubling finds no more."""
        self._full_rate = 0.0
        self._full_rounds = 0
        self._queued_rounds = 0

    @property
    def met_queue(self) -> bool:
        """Whether a queue stood in the last round of doubling."""
        return self._queued_rounds > 0

    def is_full(self, rate: DeliveryRate, *, queued: bool) -> bool:
        """Return whether doubling ends with this round; `queued`: a queue stood in it."""
        self._queued_rounds = self._queued_rounds + 1 if queued else 0
        if rate.limited_by_sender:
            return False
        if rate.best > FULL_GROWTH * self._full_rate:
            self._full_rate = rate.best
            self._full_rounds = 0
        else:
            self._full_rounds += 1
        return self._queued_rounds >= QUEUED_ROUNDS or self._full_rounds >= FULL_ROUNDS

    # -- asking for a quarter more --------------------------------------------------------------------------------

    def begin_cycle(self) -> None:
        """Begin to cruise: the rate was just found, or is to be kept for the moment."""
        self._cycle = CRUISING

    @property
    def gain(self) -> float:
        """The pacing gain of this round of cruising, relative to the estimated rate."""
        return CYCLE[self._cycle]

    def finds_more(self, settled: float, *, queued: bool) -> bool:
        """Return whether sending more found more in the round that ends; if not, go to the next gain.

        `settled` is the rate measured. What was sent at the first gain is acknowledged by the end of the second round.
        """
        if self._cycle == 0:
            self._rate_before = settled
        if self._cycle == 1 and settled > PROBE_GROWTH * self._rate_before and not queued:
            return True
        self._cycle = (self._cycle + 1) % len(CYCLE)
        return False


def is_faster(rate: float, round_max_rtt: float, min_rtt: float) -> bool:
    """Return whether a burst's second datagram waited for the first much less than this rate implies.

    `round_max_rtt` is the longest round trip of a round. On a slow path a round has too few datagrams to measure a
    quarter more, while its rate may be a hundredfold.
    """
    waits_s = DATAGRAM_BYTES / rate if rate else 0.0
    return waits_s > END_HOST_S and round_max_rtt < min_rtt + waits_s / 2
