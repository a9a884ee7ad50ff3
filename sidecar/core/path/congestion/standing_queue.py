"""Infers from the round trips of one path the queue on it, whoever fills it.

The floor is the shortest round trip of a minute. A round trip well above it means a queue, or a route that became
longer. A loss tells the two apart: a queue drops what finds it full, when the round trips are about the longest
recently seen. A radio loses datagrams at any time. (After Spike in Cen, Cosman and Voelker, "End-to-end differentiation
of congestion and wireless losses", 2003.)

On a longer route, round trips stay as long when the path sends less. They then set the new floor. (After La, Walrand
and Anantharam, "Issues in TCP Vegas", 1999.) It may be a queue that others hold: that shows as soon as it gets shorter,
as TCP's queue does with each loss.
"""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plr.sidecar.core.path.congestion.rtt import RttEstimator

LENGTH_FACTOR = 0.2
"""A round trip longer than the floor by this share, and by more than its variation, shows a queue."""
VARIATIONS = 2.5
SHORTEST_S = 0.001
FLOOR_MEMORY_S = 60.0
"""How long the shortest round trip counts as the floor. It is longer than for the minimum that sets the window: a TCP
flow whose queue never drains raises that minimum, and its losses must still count as a queue's."""
PEAK_MEMORY_S = 10.0
"""How long the longest standing queue is remembered, give or take half: about as long as TCP takes from one loss to the
next. Forgetting it early takes a loss for congestion too soon; forgetting it late misses that the path became faster.
"""
FULL = 0.8
"""A queue of this share of the longest recent one is full."""
YIELD_WINDOWS = 4
"""Number of windows after a cut whose shortest round trips are compared."""
YIELD_ROUNDS, YIELD_S = 2.0, 0.5
"""Length of a window in round trips, and its least length."""
STAYS = 0.9
"""If less sending leaves more than this share of the delay, it is not a queue."""


class FloorChange(enum.Enum):
    """What a round trip tells of the floor."""

    FELL = "fell"
    """The former floor was a queue."""
    ROSE = "rose"
    """The supposed queue is a longer route: less sending left it as it was."""


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
        """The longest round trip of this half of the memory, and of the previous half."""
        self._peak_began = 0.0
        self._stood_s: float | None = None
        """The round trip that led to sending less; None: no test is running."""
        self._windows = 0
        self._window_ends = 0.0
        self._window_least_s = self._least_s = float("inf")

    def on_cut(self, rtt: RttEstimator, now: float) -> None:
        """Test whether the queue gets shorter, since less is sent from now on because of it."""
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
        """Return whether a datagram with this round trip waited in a queue."""
        return rtt_s - self._floor_s > max(self._short_s, VARIATIONS * rtt.variation)

    def stands(self, rtt: RttEstimator) -> bool:
        """Return whether there is a queue, and not only for a moment."""
        return self.is_met_by(_standing_s(rtt), rtt)

    def is_full(self, rtt: RttEstimator) -> bool:
        """Return whether a queue stands that is about as long as any recent one."""
        peak_s = max(self._peak_s, self._peak_before_s)
        return self.stands(rtt) and _standing_s(rtt) - self._floor_s >= FULL * (peak_s - self._floor_s)

    def _stays(self, rtt_s: float, stood_s: float, rtt: RttEstimator, now: float) -> bool:
        """Return whether enough windows have passed in which nothing got shorter."""
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
        """The delay up to which a queue does not count as one."""
        return max(LENGTH_FACTOR * self._floor_s, SHORTEST_S)


def _standing_s(rtt: RttEstimator) -> float:
    """Return the round trip without momentary peaks."""
    return min(rtt.smoothed, rtt.latest)
