"""Decides how long to wait before the next attempt, by exponential backoff with full jitter."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import random


class Backoff:
    """Delays drawn uniformly from 0 to a bound that doubles from `first_s` up to `max_s`.

    Full jitter: after an outage a fleet comes back spread out, not in waves.
    """

    def __init__(self, rng: random.Random, *, first_s: float, max_s: float) -> None:
        self._rng = rng
        self._first_s = first_s
        self._max_s = self._refused_max_s = max_s
        self._bound_s = first_s

    def next_delay_s(self, *, refused: bool = False) -> float:
        """Return the delay before the next attempt, and double the bound.

        `refused`: the last attempt was, and the next one soon will be as well. The bound then begins at its largest
        value, and doubles beyond what `set_max` allows, up to what it was at first.
        """
        self._bound_s = max(self._bound_s, self._max_s) if refused else min(self._bound_s, self._max_s)
        delay_s = self._rng.uniform(0.0, self._bound_s)
        self._bound_s = min(2.0 * self._bound_s, self._refused_max_s if refused else self._max_s)
        return delay_s

    def set_max(self, max_s: float) -> None:
        """Let the bound double up to `max_s` only from now on."""
        self._max_s = max_s
        self._bound_s = min(self._bound_s, max_s)

    def reset(self) -> None:
        """Start again from the first bound, as the last attempt went well."""
        self._bound_s = self._first_s
