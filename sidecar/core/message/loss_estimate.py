"""How much a path loses, and whether in bursts: what the number of repair symbols follows."""

from __future__ import annotations

import math
from typing import NamedTuple

FAST_DATAGRAMS = 200.0
"""Memory of the estimate that rises soon after losses begin ..."""
SLOW_DATAGRAMS = 2000.0
"""... and of the one that keeps them in mind; the larger of the two counts."""
FIRST_DATAGRAMS = 100.0
"""As if so many had arrived on a new path: one loss among the first few is no loss rate."""
MAX_DISPERSION = 8.0
"""Longer bursts than this are outages: no number of repair symbols bridges them."""


class Loss(NamedTuple):
    """What to expect of a path."""

    share: float = 0.0
    """Of the datagrams, 0 to 1."""
    dispersion: float = 1.0
    """Variance of the number lost, in multiples of what independent losses have; about twice a burst's length."""


class LossEstimate:
    """Fading averages by datagrams, not by time: a quiet path forgets nothing.

    Only fates that are known count: datagrams acknowledged, and those found missing while others arrived. What a dead
    path swallowed says nothing of the path when it lives.
    """

    __slots__ = ("_expected", "_fast", "_slow", "_squares", "_weight")

    def __init__(self) -> None:
        self._fast = 0.0
        self._slow = 0.0
        self._weight = FIRST_DATAGRAMS
        self._squares = 0.0
        self._expected = 0.0

    def add(self, arrived: int, missed: int) -> None:
        """Note how many datagrams arrived and were missed since the last call."""
        known = arrived + missed
        if known <= 0:
            return
        share = missed / known
        self._fast += (share - self._fast) * -math.expm1(-known / FAST_DATAGRAMS)
        # At first, the plain average of what is known.
        self._weight = min(self._weight + known, SLOW_DATAGRAMS)
        pull = min(1.0, known / self._weight)
        self._slow += (share - self._slow) * pull
        kept = math.exp(-known / SLOW_DATAGRAMS)
        # The average was pulled towards what it is compared with: divide that out, as in any sample's variance.
        self._squares = self._squares * kept + (missed - self._slow * known) ** 2 / (1.0 - min(pull, 0.9))
        self._expected = self._expected * kept + self._slow * known

    @property
    def loss(self) -> Loss:
        """What to expect from now on."""
        # Fewer losses than a handful tell nothing of bursts.
        dispersion = (self._squares + 5.0) / (self._expected + 5.0)
        return Loss(max(self._fast, self._slow), min(max(dispersion, 1.0), MAX_DISPERSION))
