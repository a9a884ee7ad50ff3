"""Stacks blocks of one shape into arrays, so that each one's best choice at given prices is found at once.

Prices by block and server come in as an array with one column more than there are servers: the last, which is 0,
belongs to an interface that carries no copy. A price of infinity closes a server.

A `SeparableStack` holds blocks whose cost is a sum over interfaces that all carry a copy. In an optimum each interface
has one of its I cheapest servers, I being the number of interfaces: otherwise one of these is left by the others, and
moving there is cheaper and exceeds nothing. An `EnumeratedStack` lists choices. A third kind, for blocks with too many
choices to list, is in `pattern_batch`.
"""

from __future__ import annotations

import abc
import itertools
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from plr.controlplane.core.problem.costs import choice_costs
from plr.controlplane.core.problem.domains import repeats
from plr.controlplane.core.problem.objectives import epsilon_matrix, path_costs
from plr.controlplane.core.solve.enumeration import (
    OWN_EXCESS_PRICE,
    combinations,
    list_choices,
    nearest,
    own_excess,
    tried_of_each,
)
from plr.controlplane.core.solve.matching import cheapest_matching
from plr.controlplane.core.solve.path_bound import PathBound, path_bound

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from plr.controlplane.core.problem.problem import Block, Choice, Objective
    from plr.controlplane.core.solve.enumeration import Near
    from plr.controlplane.core.solve.limits import Limits

    Floats = NDArray[np.float64]
    Indices = NDArray[np.intp]

MAX_TRIED = 4
"""Interfaces up to which the I cheapest servers of each are combined in all I^I ways; with more, each block is
matched."""


class Best(NamedTuple):
    """The best choice of each requested block."""

    value: Floats
    """Cost plus prices; infinite if all servers of an interface are closed."""
    excess: Indices
    """Number of interfaces by which the block's own capacity is exceeded."""
    picks: Indices
    """By block, then interface: the server's index, or the stack's number of servers if the interface has none."""
    least: Floats
    """Lower bound over all choices, with `excess_price` for each interface in excess. Where an `EnumeratedStack` has
    listed only some choices, it holds for these; `Stack.bound` holds for all."""


class Stack(abc.ABC):
    """Some blocks with equally many interfaces."""

    def __init__(self, blocks: Sequence[Block], limits: Limits) -> None:
        self.blocks = tuple(blocks)
        self.interfaces = len(blocks[0].interfaces)
        self.servers = max(len(block.servers) for block in blocks)
        self.every = np.arange(len(blocks))
        """The rows of all blocks."""
        self.limit: Indices = np.full((len(blocks), self.servers + 1), len(limits), dtype=np.intp)
        """By block and server: the number of the limit over all robots."""
        for row, block in enumerate(blocks):
            self.limit[row, : len(block.servers)] = limits.of_block(block)

    @cached_property
    def free(self) -> Best:
        """The best choices of all blocks when nothing has a price."""
        return self.best(self.every, np.zeros((len(self.blocks), self.servers + 1)))

    @abc.abstractmethod
    def best(self, rows: Indices, price: Floats, excess_price: float = OWN_EXCESS_PRICE) -> Best:
        """Return the best choice of these blocks at these prices, of the servers and of an interface in excess."""

    @abc.abstractmethod
    def near(self, row: int, price: Floats, margin: float, at_most: int) -> Near:
        """Return choices of one block within `margin` of its best."""

    def bound(self, price: Floats, best: Best, forced: Indices, excess_price: float) -> Floats:
        """Return a lower bound on the best of each block, given `best` at these prices, with `excess_price` for each
        interface by which it exceeds the block's own capacity beyond what it must (`forced`)."""
        least: Floats = best.least - excess_price * forced
        return least

    def picks_of(self, choice: Choice) -> list[int]:
        """Convert a choice to this stack's numbering."""
        return [self.servers if server is None else server for server in choice]

    def choice_of(self, picks: Iterable[int]) -> Choice:
        """Convert picks back to a choice."""
        return tuple(None if server == self.servers else int(server) for server in picks)


class SeparableStack(Stack):
    """Blocks whose cost is a sum over interfaces."""

    def __init__(self, objective: Objective, blocks: Sequence[Block], limits: Limits) -> None:
        super().__init__(blocks, limits)
        self._cost = np.full((len(blocks), self.interfaces, self.servers), np.inf)
        for row, block in enumerate(blocks):
            self._cost[row, :, : len(block.servers)] = path_costs(objective, epsilon_matrix(block))
        self._capacity = np.array([block.capacity or self.interfaces for block in blocks])

    def best(self, rows: Indices, price: Floats, excess_price: float = OWN_EXCESS_PRICE) -> Best:
        priced = self._cost[rows] + price[:, None, : self.servers]
        picks = priced.argmin(axis=2)
        value = np.take_along_axis(priced, picks[:, :, None], 2)[:, :, 0].sum(axis=1)
        excess = repeats(picks, self._capacity[rows])
        crowded = np.flatnonzero(excess)
        if crowded.size:
            solve = _try_all if self.interfaces <= MAX_TRIED else _match
            solved = solve(priced[crowded], self._capacity[rows[crowded]], excess_price)
            value[crowded], excess[crowded], picks[crowded] = solved
        return Best(value, excess, picks, value + excess_price * excess)

    def near(self, row: int, price: Floats, margin: float, at_most: int) -> Near:
        priced = self._cost[row] + price[: self.servers]
        (value,) = self.best(np.array([row]), price[None]).value
        slack = value + margin - priced.min(axis=1).sum()
        share = tried_of_each(self.interfaces, at_most)
        options = []
        complete = True
        for costs in priced:
            order = np.argsort(costs, kind="stable")
            within = order[(costs[order] <= costs.min() + slack + 1e-9) & np.isfinite(costs[order])]
            complete = complete and len(within) <= share
            options.append(within[:share])
        picks = np.array(list(itertools.product(*options)), dtype=np.intp)
        values = priced[np.arange(self.interfaces), picks].sum(axis=1)
        return nearest(values, repeats(picks, self._capacity[row]), picks, margin, at_most, complete=complete)


def _try_all(priced: Floats, capacity: Indices, excess_price: float) -> tuple[Floats, Indices, Indices]:
    interfaces, servers = priced.shape[1:]
    tried = min(interfaces, servers)
    cheapest = np.argpartition(priced, tried - 1, axis=2)[:, :, :tried]
    grid, rows = combinations(interfaces, tried), np.arange(interfaces)
    picks = cheapest[:, rows, grid]
    values = np.take_along_axis(priced, cheapest, 2)[:, rows, grid].sum(axis=2)
    excess = repeats(picks, capacity[:, None])
    at = np.arange(len(priced)), (values + excess_price * excess).argmin(axis=1)
    return values[at], excess[at], picks[at]


def _match(priced: Floats, capacity: Indices, excess_price: float) -> tuple[Floats, Indices, Indices]:
    found = [cheapest_matching(costs, int(slots), excess_price) for costs, slots in zip(priced, capacity, strict=True)]
    picks = np.array(found, dtype=np.intp)
    value = np.take_along_axis(priced, picks[:, :, None], 2)[:, :, 0].sum(axis=1)
    return value, repeats(picks, capacity), picks


class EnumeratedStack(Stack):
    """Blocks whose choices are listed.

    If a block has more than `at_most` choices, only the promising ones are listed. `best` and `near` then find the best
    of these, and the block's bound comes from `path_bound`.
    """

    def __init__(self, objective: Objective, blocks: Sequence[Block], limits: Limits, *, at_most: int) -> None:
        super().__init__(blocks, limits)
        lists = [list_choices(block, at_most) for block in blocks]
        longest = max(len(listed.choices) for listed in lists)
        self._choices: Indices = np.full((len(blocks), longest, self.interfaces), self.servers, dtype=np.intp)
        self._cost = np.full((len(blocks), longest), np.inf)
        self._excess = np.zeros((len(blocks), longest), dtype=np.intp)
        self._count = [len(listed.choices) for listed in lists]
        self._trimmed: dict[int, PathBound] = {}
        """Bounds of incompletely listed blocks, by row."""
        for row, (block, (choices, complete)) in enumerate(zip(blocks, lists, strict=True)):
            count = len(choices)
            self._cost[row, :count] = choice_costs(objective, block, choices)
            self._choices[row, :count] = np.where(choices < 0, self.servers, choices)
            self._excess[row, :count] = own_excess(block, choices)
            if not complete:
                self._trimmed[row] = path_bound(objective, block)

    def _priced(self, rows: Indices, price: Floats) -> Floats:
        values = self._cost[rows]
        for interface in range(self.interfaces):
            values = values + np.take_along_axis(price, self._choices[rows, :, interface], 1)
        return values

    def best(self, rows: Indices, price: Floats, excess_price: float = OWN_EXCESS_PRICE) -> Best:
        values = self._priced(rows, price)
        ranks = values + excess_price * self._excess[rows]
        chosen = ranks.argmin(axis=1)
        at = np.arange(len(rows)), chosen
        return Best(values[at], self._excess[rows, chosen], self._choices[rows, chosen], ranks[at])

    def near(self, row: int, price: Floats, margin: float, at_most: int) -> Near:
        count = self._count[row]
        values = self._priced(np.array([row]), price[None])[0, :count]
        return nearest(
            values,
            self._excess[row, :count],
            self._choices[row, :count],
            margin,
            at_most,
            complete=row not in self._trimmed,
        )

    def bound(self, price: Floats, best: Best, forced: Indices, excess_price: float) -> Floats:
        bound = super().bound(price, best, forced, excess_price)
        for row, paths in self._trimmed.items():
            bound[row] = paths.at(price[row], int(forced[row]), excess_price)
        return bound
