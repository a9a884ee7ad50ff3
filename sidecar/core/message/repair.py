"""How many repair symbols a message gets, and what is worth sending twice."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING

from sidecar.core.wire import fec

if TYPE_CHECKING:
    from sidecar.core.message.loss_estimate import Loss

Redundancy = float | None
"""Repair symbols for each source symbol (0 to 1), or None: as many as the measured loss asks for."""

FAILURES = 0.002
"""Share of messages that may still need a retransmission."""
FLOOR = 0.0005
"""Below this loss nothing is added: sixteen of seventeen messages of 150 kB get through untouched, and a single loss
long ago costs nothing for ever."""
MAX_RATIO = 0.5
"""Of the source symbols, when the measured loss decides: beyond it, sending again is cheaper."""
WORTH_A_COPY = 0.005
"""What is lost with this probability, at the cost of a further round trip, travels twice: see `worth_a_copy`."""
MAX_COPIES = 16
"""So many symbols lost at once, and no more, travel twice: more of them are an outage or a full queue."""
_STEPS_PER_OCTAVE = 4
"""Losses are rounded up to so many steps, so that results can be kept."""


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
    """Whether datagrams that nothing else covers, and whose loss costs a round trip, should travel twice.

    Such are a message's last one, whose loss only a timeout tells (also the answer of one datagram: its loss makes
    the whole exchange late), and those that are sent again: about 5 % of messages of 150 kB lose one of them at 2 %
    loss. Copies and not repair symbols, since they are few, need no coding on either side, and can take another path.
    """
    return datagrams <= MAX_COPIES and 1.0 - (1.0 - loss.share) ** datagrams >= WORTH_A_COPY


@lru_cache(maxsize=4096)
def _of_block(size: int, blocks: int, burst: int, step: int) -> int:
    """The fewest repair symbols with which a block of `size` fails no more often than FAILURES / blocks.

    Bursts of `burst` datagrams are lost independently of each other (binomial).
    """
    share = min(2.0 ** (step / _STEPS_PER_OCTAVE), 0.99)
    most = max(1, int(size * MAX_RATIO))
    for repairs in range(most):
        if _more_than(repairs // burst, math.ceil((size + repairs) / burst), share) <= FAILURES / blocks:
            return repairs
    return most


def _more_than(most: int, trials: int, share: float) -> float:
    """Probability that more than `most` of `trials` happen."""
    probability = (1.0 - share) ** trials
    below = probability
    for hits in range(1, most + 1):
        probability *= (trials - hits + 1) / hits * share / (1.0 - share)
        below += probability
    return 1.0 - below
