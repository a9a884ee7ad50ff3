"""Represents choices of a block as arrays: each row holds the index of the server of each interface."""

from __future__ import annotations

import itertools
import math
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from plr.controlplane.core.problem.domains import repeats
from plr.controlplane.core.problem.objectives import epsilon_matrix, log_lift

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from plr.controlplane.core.problem.problem import Block

    Floats = NDArray[np.float64]
    Indices = NDArray[np.intp]

OWN_EXCESS_PRICE = 1e6
"""Price of an interface beyond the block's own capacity: more than any cost and any price of a server."""


MOST_DIMENSIONS = 32
"""Limit on the dimensions of numpy's arrays, by some of its functions."""

MAX_LISTED_CHOICES = 4096
"""Choices examined of one block: 2 interfaces with 64 servers, 3 with 16, 4 with 8."""

TRIED_A_CHOICE = 16
"""Combinations of cheap servers examined for each choice wanted near a block's best."""

CHOICES_A_WAY = 4
"""Minimum room in choices for each set of interfaces that carries copies."""


class Near(NamedTuple):
    """Choices of one block that are nearly its best."""

    values: Floats
    excess: Indices
    picks: Indices
    complete: bool
    """Whether these are all within the margin."""


@lru_cache(maxsize=64)
def combinations(interfaces: int, options: int) -> Indices:
    """Return every way to give each interface one of `options`."""
    return np.indices((options,) * interfaces, dtype=np.intp).reshape(interfaces, -1).T.copy()


def own_excess(block: Block, choices: Indices) -> Indices:
    """Return `problem.block_excess` of many choices, one per row."""
    if not block.capacity or not block.idempotent or block.target is not None:
        return np.zeros(len(choices), dtype=np.intp)
    return repeats(choices, np.array(block.capacity))


class Listed(NamedTuple):
    """Listed choices of one block."""

    choices: Indices
    complete: bool
    """Whether there are no others."""


def list_choices(block: Block, at_most: int) -> Listed:
    """List the block's choices, -1 where an interface carries no copy.

    If there are more than `at_most`, list those among the most promising servers of each interface. If even the ways to
    leave interfaces out are too many, list those that leave out the worst.
    """
    epsilon = epsilon_matrix(block)
    there = ~np.isnan(epsilon)
    if not block.idempotent:
        return _list_single(block, epsilon, at_most)
    ways, complete = _ways(block, epsilon, np.arange(len(epsilon)), at_most)
    share = epsilon.shape[1]
    counts = there.sum(axis=1)
    while share > 1 and sum(math.prod(int(min(counts[i], share)) for i in way) for way in ways) > at_most:
        share -= 1
    options = [_promising(block, i, np.flatnonzero(row), share) for i, row in enumerate(there)]
    complete = complete and share >= counts.max()
    return Listed(np.concatenate([_all_of(way, options) for way in ways]), complete)


def _list_single(block: Block, epsilon: Floats, at_most: int) -> Listed:
    """List choices of one server, over as many of the interfaces that reach it as are wanted."""
    lists = []
    complete = True
    servers = np.flatnonzero(~np.isnan(epsilon).all(axis=0))
    for server in servers:
        ways, all_ways = _ways(block, epsilon, np.flatnonzero(~np.isnan(epsilon[:, server])), at_most // len(servers))
        complete = complete and all_ways
        choices = np.full((len(ways), len(epsilon)), -1, dtype=np.intp)
        for row, way in enumerate(ways):
            choices[row, way] = server
        lists.append(choices)
    return Listed(np.concatenate(lists), complete)


def _ways(block: Block, epsilon: Floats, usable: Indices, at_most: int) -> tuple[list[list[int]], bool]:
    """Return the sets of usable interfaces that may carry copies: all, or, if these are too many, the best of each
    size."""
    least, most = block.copies_wanted
    sizes = range(min(least, len(usable)), min(most, len(usable)) + 1)
    if sum(math.comb(len(usable), size) for size in sizes) <= max(1, at_most // CHOICES_A_WAY):
        return [list(way) for size in sizes for way in itertools.combinations(usable.tolist(), size)], True
    best_first = usable[np.argsort(np.nanmin(epsilon[usable], axis=1), kind="stable")].tolist()
    return [sorted(best_first[:size]) for size in sizes], len(sizes) == 1 and sizes[0] == len(usable)


def _promising(block: Block, interface: int, servers: Indices, share: int) -> Indices:
    """Return up to `share` of an interface's servers: in turn the one with the least epsilon, the one with the least in
    another region, and, if charges count, the cheapest."""
    if len(servers) <= share:
        return servers
    best_first = sorted(servers.tolist(), key=lambda server: block.epsilon[interface][server] or 0.0)
    rankings = [best_first]
    if block.regions:
        of_region = {block.regions[server] or server: server for server in reversed(best_first)}
        rankings.append(sorted(of_region.values(), key=best_first.index))
    if block.target is not None:
        charges = block.target.charges[interface]
        rankings.append(sorted(best_first, key=lambda server: charges[server]))
    turns = itertools.chain.from_iterable(itertools.zip_longest(*rankings))
    return np.array(list(dict.fromkeys(server for server in turns if server is not None))[:share], dtype=np.intp)


def _all_of(way: list[int], options: list[Indices]) -> Indices:
    """Return every way to give the named interfaces one of their options, and the others none."""
    if len(way) > MOST_DIMENSIONS:
        rows = np.array(list(itertools.product(*(options[i] for i in way))), dtype=np.intp)
        choices = np.full((len(rows), len(options)), -1, dtype=np.intp)
        choices[:, way] = rows
        return choices
    grids = np.meshgrid(*(options[i] for i in way), indexing="ij")
    choices = np.full((grids[0].size, len(options)), -1, dtype=np.intp)
    for i, grid in zip(way, grids, strict=True):
        choices[:, i] = grid.ravel()
    return choices


def lift_floor(block: Block) -> float:
    """Return the least that all lifts of a choice together add to the logarithm of its miss probability; at most 0."""
    least: dict[tuple[int, int], float] = {}
    for ((i, _), (k, _)), lift in block.lifts.items():
        least[i, k] = min(least.get((i, k), 0.0), log_lift(lift))
    return sum(least.values())


def tried_of_each(interfaces: int, at_most: int) -> int:
    """Return how many servers of each interface to combine, to find `at_most` choices near the best."""
    return max(1, int(min(MAX_LISTED_CHOICES, TRIED_A_CHOICE * at_most) ** (1 / interfaces) + 1e-9))


def nearest(values: Floats, excess: Indices, picks: Indices, margin: float, at_most: int, *, complete: bool) -> Near:
    """Return the choices of one block that are within `margin` of the best, the best first.

    With an infinite margin, include those that exceed the block's own capacity more than necessary.
    """
    rank = values + OWN_EXCESS_PRICE * excess
    order = np.argsort(rank, kind="stable")
    within = order[(rank[order] <= rank[order[0]] + margin + 1e-9) & np.isfinite(values[order])]
    kept = within[:at_most]
    return Near(values[kept], excess[kept], picks[kept], complete and len(within) == len(kept))
