"""Choices of a block as arrays: a row each, of the index of the server of each interface."""

from __future__ import annotations

import itertools
import math
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from controlplane.core.objectives import PROBABILITY_FLOOR, epsilon_matrix
from controlplane.core.problem import reachable

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from controlplane.core.problem import Block

    Floats = NDArray[np.float64]
    Indices = NDArray[np.intp]

OWN_EXCESS_PRICE = 1e6
"""Of an interface beyond the block's own capacity: more than any cost and any price of a server."""


MAX_LISTED = 4096
"""Choices looked at of one block: 2 interfaces with 64 servers, 3 with 16, 4 with 8."""


class Near(NamedTuple):
    """Choices of one block that are nearly its best."""

    values: Floats
    excess: Indices
    picks: Indices
    complete: bool
    """Whether these are all within the margin."""


@lru_cache(maxsize=64)
def combinations(interfaces: int, options: int) -> Indices:
    """Every way to give each interface one of `options`."""
    return np.indices((options,) * interfaces, dtype=np.intp).reshape(interfaces, -1).T.copy()


def own_excess(picks: Indices, capacity: Indices) -> Indices:
    """By how many interfaces each choice exceeds the block's own capacity; interfaces are the last dimension."""
    excess = np.zeros(picks.shape[:-1], dtype=np.intp)
    for interface in range(1, picks.shape[-1]):
        before = (picks[..., :interface] == picks[..., interface, None]).sum(axis=-1)
        excess += before >= capacity
    return excess


def count_choices(block: Block) -> int:
    """How many choices a block has, whatever they exceed."""
    if not block.idempotent:
        return len({server for row in block.epsilon for server in reachable(row)})
    return math.prod(len(reachable(row)) for row in block.epsilon)


def list_choices(block: Block, at_most: int) -> Indices:
    """The block's choices, -1 where an interface gets no server.

    Of more than `at_most`, those among the servers with the least epsilon for each interface.
    """
    epsilon = epsilon_matrix(block)
    there = ~np.isnan(epsilon)
    if not block.idempotent:
        used = np.flatnonzero(there.any(axis=0))
        return np.where(there[:, used], used, -1).T
    options = [np.flatnonzero(row) for row in there]
    if count_choices(block) > at_most:
        share = max(1, int(at_most ** (1 / len(options)) + 1e-9))
        options = [row[np.argsort(epsilon[i, row], kind="stable")[:share]] for i, row in enumerate(options)]
    return np.array(list(itertools.product(*options)), dtype=np.intp)


def lift_floor(block: Block) -> float:
    """What all lifts of a choice together add at least to the logarithm of its miss probability; at most 0."""
    least: dict[tuple[int, int], float] = {}
    for ((i, _), (k, _)), lift in block.lifts.items():
        least[i, k] = min(least.get((i, k), 0.0), math.log(max(lift, PROBABILITY_FLOOR)))
    return sum(least.values())


def nearest(values: Floats, excess: Indices, picks: Indices, margin: float, at_most: int, *, complete: bool) -> Near:
    """Of these choices of one block those within `margin` of the best, the best first.

    With an infinite margin also those that exceed the block's own capacity by more than need be.
    """
    rank = values + OWN_EXCESS_PRICE * excess
    order = np.argsort(rank, kind="stable")
    within = order[(rank[order] <= rank[order[0]] + margin + 1e-9) & np.isfinite(values[order])]
    kept = within[:at_most]
    return Near(values[kept], excess[kept], picks[kept], complete and len(within) == len(kept))
