"""Decides how much of old evidence still counts when one thing has not been reported while its group has.

What keeps being measured fades slowly, as its past is worth something beside its present. A server that nobody asks any
more may be idle by now, or busy: the longer its group was asked without it, the less its past says of its present (a
restless bandit, Whittle 1988). Pauses in which none of the group was reported do not count.
"""

from __future__ import annotations

import math

GRACE_S = 2.0
"""Silence up to this long takes nothing away: reports of what is in use have gaps."""

HALF_LIFE_S = 3.0
"""Half-life, from then on, of evidence that is not refreshed: loads and radio cells change within some ten seconds."""

LONGEST_GAP_S = 2.0
"""Longest gap between two reports on any of a group; more is a pause."""


class HeardClock:
    """How long a group of similar things has been reported: seconds without pauses."""

    __slots__ = ("_at", "seconds")

    def __init__(self, now: float) -> None:
        self.seconds = 0.0
        self._at = now

    def hear(self, now: float) -> None:
        """Note that one of them was reported; call this before counting it."""
        self.seconds += min(now - self._at, LONGEST_GAP_S)
        self._at = now


class Silence:
    """How long one of the group has not been reported, by the group's clock; without a clock there is no silence."""

    __slots__ = ("_clock", "_since")

    def __init__(self, clock: HeardClock | None) -> None:
        self._clock = clock
        self._since = clock.seconds if clock is not None else 0.0

    def kept(self) -> float:
        """Return the share of its evidence that still counts."""
        if self._clock is None:
            return 1.0
        over_s = self._clock.seconds - self._since - GRACE_S
        return 1.0 if over_s <= 0.0 else math.exp2(-over_s / HALF_LIFE_S)

    def end(self) -> float:
        """End the silence; return the share of its older evidence that counts from now on."""
        kept = self.kept()
        if self._clock is not None:
            self._since = self._clock.seconds
        return kept
