"""What the round trips of one path tell of the queue on it, whosever that is.

The floor is the least round trip of a minute. What is well above it is a queue, or a route that became longer. A loss
tells the two apart: a queue loses what finds it full, when the round trips are about the longest of late. What a radio
loses, it loses at any time. (After Spike in Cen, Cosman and Voelker, "End-to-end differentiation of congestion and
wireless losses", 2003.)

Where the route became longer, round trips stay as long as they are when the path sends less. Then theirs is the new
floor. (After La, Walrand and Anantharam, "Issues in TCP Vegas", 1999.) It may be a queue that others hold: that is
found out as soon as it gets shorter, as a queue of TCP's does with each loss.
"""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sidecar.core.path.congestion.rtt import RttEstimator

LENGTH_FACTOR = 0.2
"""A round trip that is longer than the floor by this share, and by more than it varies, shows a queue."""
VARIATIONS = 2.5
SHORTEST_S = 0.001
FLOOR_MEMORY_S = 60.0
"""How long the least round trip counts as the floor. Longer than the minimum that sets the window: the queue of a TCP
flow that never drains raises that one, and its losses must still be seen as a queue's."""
PEAK_MEMORY_S = 10.0
"""How long the longest standing queue is remembered, give or take half: about as long as TCP takes from one loss to
the next. Forgetting it early takes a loss for congestion too soon; late, misses that the path became faster."""
FULL = 0.8
"""A queue of this share of the longest of late is full."""
YIELD_WINDOWS = 4
"""After a cut the least round trips of so many windows are looked at."""
YIELD_ROUNDS, YIELD_S = 2.0, 0.5
"""Round trips of a window, and its least length."""
STAYS = 0.9
"""What was left of a queue by less sending, if it is more than this share of what stood, is none."""


class FloorChange(enum.Enum):
    """What a round trip told of the floor."""

    FELL = "fell"
    """What was taken for the floor was a queue."""
    ROSE = "rose"
    """What was taken for a queue is a longer route: less sending left it as it was."""


class StandingQueue:
    """The queue that datagrams of one path meet. Times in seconds."""

    __slots__ = (
        "_floor_at",
        "_floor_s",
        "_least_s",
        "_peak_before_s",
        "_peak_began",
        "_peak_s",
        "_stood_s",
        "_window_ends",
        "_window_least_s",
        "_windows",
    )

    def __init__(self) -> None:
        self._floor_s = float("inf")
        self._floor_at = 0.0
        self._peak_s = self._peak_before_s = 0.0
        """The longest round trip of this half of the memory, and of the half before."""
        self._peak_began = 0.0
        self._stood_s: float | None = None
        """The round trips when less began to be sent because of them; None: nothing is to be found out."""
        self._windows = 0
        self._window_ends = 0.0
        self._window_least_s = self._least_s = float("inf")

    def on_cut(self, rtt: RttEstimator, now: float) -> None:
        """Less is sent from now on because of this queue: see whether it gets shorter."""
        if self._stood_s is None:
            self._stood_s = _standing_s(rtt)
            # What comes within a round trip was sent before.
            self._windows, self._window_ends = -1, now + rtt.smoothed
            self._window_least_s = self._least_s = float("inf")

    def note(self, rtt_s: float, rtt: RttEstimator, now: float) -> FloorChange | None:
        """Take one round trip."""
        if self._stood_s is not None and self._stays(rtt_s, self._stood_s, rtt, now):
            self._stood_s = None
            self._floor_s, self._floor_at = self._least_s, now
            self._peak_s = self._peak_before_s = 0.0
            return FloorChange.ROSE
        fell = rtt_s < self._floor_s - self._short_s
        if rtt_s <= self._floor_s:
            self._floor_s, self._floor_at = rtt_s, now
        elif now - self._floor_at > FLOOR_MEMORY_S:
            self._floor_s, self._floor_at = rtt.minimum, now
        if now - self._peak_began > PEAK_MEMORY_S / 2:
            self._peak_before_s, self._peak_s, self._peak_began = self._peak_s, 0.0, now
        self._peak_s = max(self._peak_s, _standing_s(rtt))
        return FloorChange.FELL if fell else None

    def is_met_by(self, rtt_s: float, rtt: RttEstimator) -> bool:
        """Whether a datagram that took so long waited in a queue."""
        return rtt_s - self._floor_s > max(self._short_s, VARIATIONS * rtt.variation)

    def stands(self, rtt: RttEstimator) -> bool:
        """Whether there is a queue, and not only for a moment."""
        return self.is_met_by(_standing_s(rtt), rtt)

    def is_full(self, rtt: RttEstimator) -> bool:
        """Whether a queue stands that is about as long as any of late."""
        peak_s = max(self._peak_s, self._peak_before_s)
        return self.stands(rtt) and _standing_s(rtt) - self._floor_s >= FULL * (peak_s - self._floor_s)

    def _stays(self, rtt_s: float, stood_s: float, rtt: RttEstimator, now: float) -> bool:
        """Whether windows enough are over in which nothing got shorter."""
        self._window_least_s = min(self._window_least_s, rtt_s)
        if now < self._window_ends:
            return False
        if self._windows >= 0:
            least_s = self._window_least_s + VARIATIONS * rtt.variation
            if least_s - self._floor_s < STAYS * (stood_s - self._floor_s):
                self._stood_s = None
                return False
            self._least_s = min(self._least_s, self._window_least_s)
        self._windows += 1
        self._window_ends = now + max(YIELD_ROUNDS * rtt.smoothed, YIELD_S)
        self._window_least_s = float("inf")
        return self._windows >= YIELD_WINDOWS

    @property
    def _short_s(self) -> float:
        """What a queue shorter than this is taken for none."""
        return max(LENGTH_FACTOR * self._floor_s, SHORTEST_S)


def _standing_s(rtt: RttEstimator) -> float:
    """The round trip without what was only for a moment."""
    return min(rtt.smoothed, rtt.latest)
