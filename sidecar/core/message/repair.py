"""Decides how many repair symbols a message gets, and what is worth sending twice.

Both follow how much a path loses, and whether it loses in bursts.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

from plr.sidecar.core.wire import fec

FAST_DATAGRAMS = 200.0
"""Memory of the estimate that rises soon after losses begin ..."""
SLOW_DATAGRAMS = 2000.0
"""... and of the one that remembers them longer; the larger of the two counts."""
FIRST_DATAGRAMS = 100.0
"""Datagrams counted as arrived on a new path: one loss among the first few is no loss rate."""
MAX_DISPERSION = 8.0
"""Longer bursts than this are outages: no number of repair symbols bridges them."""


class Loss(NamedTuple):
    """The expected loss of a path."""

    share: float = 0.0
    """Share of the datagrams, 0 to 1."""
    dispersion: float = 1.0
    """Variance of the number lost, relative to that of independent losses; about twice a burst's length."""


class LossEstimate:
    """Averages that fade by datagrams, not by time: a quiet path forgets nothing.

    Only known fates count: datagrams acknowledged, and those found missing while others arrived. What a dead path
    swallowed says nothing of the path when it lives.
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
        # The average was pulled towards the value it is compared with: divide that out, as in any sample variance.
        self._squares = self._squares * kept + (missed - self._slow * known) ** 2 / (1.0 - min(pull, 0.9))
        self._expected = self._expected * kept + self._slow * known

    @property
    def loss(self) -> Loss:
        """The loss to expect from now on."""
        # Fewer than a handful of losses say nothing about bursts.
        dispersion = (self._squares + 5.0) / (self._expected + 5.0)
        return Loss(max(self._fast, self._slow), min(max(dispersion, 1.0), MAX_DISPERSION))


Redundancy = float | None
"""Repair symbols for each source symbol (0 to 1), or None: as many as the measured loss asks for."""

FAILURES = 0.002
"""Share of messages that may still need a retransmission."""
FLOOR = 0.0005
"""Below this loss nothing is added: sixteen of seventeen messages of 150 kB get through untouched, and a single loss
long ago stops costing anything."""
MAX_RATIO = 0.5
"""Most repair symbols per source symbol when the measured loss decides: beyond it, sending again is cheaper."""
WORTH_A_COPY = 0.005
"""Datagrams with at least this probability of a loss, which costs a round trip, travel twice: see `worth_a_copy`."""
MAX_DOUBLED_SYMBOLS = 16
"""Most symbols lost at once that travel twice: more of them are an outage or a full queue."""
_STEPS_PER_OCTAVE = 4
"""Losses are rounded up to this many steps per octave, so that results can be cached."""


def repair_symbols(count: int, redundancy: Redundancy, loss: Loss) -> int:
    """Return the number of repair symbols for a message of `count` source symbols over a path of this loss."""
    if redundancy is not None:
        return min(math.ceil(count * redundancy), fec.max_repairs(count))
    if loss.share < FLOOR:
        return 0
    if count == 1:
        return 0
    blocks = fec.block_count(count)
    # A burst hits the blocks in turn.
    burst = max(1, math.ceil(loss.dispersion / blocks))
    step = math.ceil(math.log2(loss.share) * _STEPS_PER_OCTAVE)
    return min(_of_block(-(-count // blocks), blocks, burst, step) * blocks, fec.max_repairs(count))


def worth_a_copy(datagrams: int, loss: Loss) -> bool:
    """Return whether datagrams that nothing else covers, and whose loss costs a round trip, should travel twice.

    One such is a message's last datagram, whose loss only a timeout tells (also a one-datagram answer, whose loss makes
    the whole exchange late). Others are those sent again: about 5 % of messages of 150 kB lose one of them at 2 % loss.
    They get copies instead of repair symbols, since they are few, need no coding on either side, and can take another
    path.
    """
    return datagrams <= MAX_DOUBLED_SYMBOLS and 1.0 - (1.0 - loss.share) ** datagrams >= WORTH_A_COPY


@lru_cache(maxsize=4096)
def _of_block(size: int, blocks: int, burst: int, step: int) -> int:
    """Return the fewest repair symbols with which a block of `size` fails at most in a share of FAILURES / blocks.

    Bursts of `burst` datagrams are lost independently of each other (binomial).
    """
    share = min(2.0 ** (step / _STEPS_PER_OCTAVE), 0.99)
    most = max(1, int(size * MAX_RATIO))
    for repairs in range(most):
        if _more_than(repairs // burst, math.ceil((size + repairs) / burst), share) <= FAILURES / blocks:
            return repairs
    return most


def _more_than(most: int, trials: int, share: float) -> float:
    """Return the probability that more than `most` of `trials` happen."""
    probability = (1.0 - share) ** trials
    below = probability
    for hits in range(1, most + 1):
        probability *= (trials - hits + 1) / hits * share / (1.0 - share)
        below += probability
    return 1.0 - below
