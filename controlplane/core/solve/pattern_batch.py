"""Finds the best choice of blocks with too many choices to list, by patterns of server groups.

At given prices, the best server of each group is taken (`server_groups`), and then the best of all patterns. If that
puts more interfaces on a server than the block's own capacity allows, the search branches: for each of these interfaces
in turn, that one may not go there. The best pattern's value is a bound. It is what the choice is worth, except where
lifts above 1 are capped (`objectives`), and where servers share a group that are not alike.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import numpy as np

from plr.controlplane.core.problem.costs import RULE_PRICE
from plr.controlplane.core.solve.batch import Best, Stack
from plr.controlplane.core.solve.batch_costs import StackedCosts
from plr.controlplane.core.solve.enumeration import (
    MAX_LISTED_CHOICES,
    OWN_EXCESS_PRICE,
    TRIED_A_CHOICE,
    combinations,
    nearest,
    tried_of_each,
)
from plr.controlplane.core.solve.matching import forced_excess
from plr.controlplane.core.solve.server_groups import ROWS_AT_ONCE, ServerGroups, violations

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from plr.controlplane.core.problem.problem import Block, Objective
    from plr.controlplane.core.solve.enumeration import Near
    from plr.controlplane.core.solve.limits import Limits

    Floats = NDArray[np.float64]
    Indices = NDArray[np.intp]

MAX_BRANCHINGS = 6
"""Rounds in which interfaces are kept from servers; each is for fewer blocks."""

MAX_OPEN, MIN_OPEN = 64, 8
"""Limit on the choices of one block that are branched in one round, and how many have room in any case. The others stay
as they are, and their bound with them."""

MAX_OPEN_ALL = 16_384
"""The same for all blocks together; with 8 interfaces each makes 8 more."""

MIN_GAIN = 1e-12
"""Values closer than this are equal: rounding."""


class PatternStack(Stack):
    """Blocks without a target whose service may run on several servers, with up to `at_most` patterns each."""

    def __init__(self, objective: Objective, blocks: Sequence[Block], limits: Limits, *, at_most: int) -> None:
        super().__init__(blocks, limits)
        self._costs = StackedCosts(objective, blocks, self.servers)
        self._paths = np.concatenate([self._costs.of_path, np.full((len(blocks), self.interfaces, 1), np.inf)], axis=2)
        self._least_copies, self._most_copies = np.array([block.copies_wanted for block in blocks]).T
        self._forced = np.array([forced_excess(block) for block in blocks])
        share = max(1, int(at_most ** (1 / self.interfaces) + 1e-9))
        self._groups = ServerGroups(blocks, self._costs, share)
        self._classes = combinations(self.interfaces, self._groups.count)
        shared = violations(blocks, self._costs, self._groups)
        self._least_shared = np.where(shared < 0, np.iinfo(shared.dtype).max, shared).min(axis=1)
        self._shared = shared if self._least_shared.any() or shared.any() else None
        self._lifts = self._lift_tables() if self._costs.has_lifts else {}
        self._pattern_cost = self._pattern_costs()
        self._may_cap = np.zeros(len(blocks), dtype=np.bool_)
        """By block: whether some lift is above 1."""
        for table in self._lifts.values():
            self._may_cap |= (table > 0).any(axis=(1, 2))

    def _lift_tables(self) -> dict[tuple[int, int], Floats]:
        """Return by pair of interfaces the logarithms of the lifts between groups, for each block."""
        single, count = self._groups.single, self._groups.count
        rows, alone = self.every[:, None, None], single.shape[2]
        tables = {}
        for i, k in itertools.combinations(range(self.interfaces), 2):
            table = np.zeros((len(self.blocks), count, count))
            servers = single[:, i, :, None], single[:, k, None, :]
            there = (servers[0] < self.servers) & (servers[1] < self.servers)
            lifts = self._costs.log_lifts(rows, i, servers[0], k, servers[1])
            table[:, :alone, :alone] = np.where(there, lifts, 0.0)
            tables[i, k] = table
        return tables

    def _pattern_costs(self) -> Floats:
        """Return what each pattern costs besides the paths, by block and pattern."""
        count = self._groups.count
        found = np.zeros((len(self.blocks), *([count] * self.interfaces)))
        for (i, k), table in self._lifts.items():
            shape = [count if axis in (i, k) else 1 for axis in range(self.interfaces)]
            found += table.reshape(-1, *shape)
        costs = found.reshape(len(self.blocks), -1)
        if self._shared is not None:
            costs += RULE_PRICE * self._shared
            costs[self._shared < 0] = np.inf
        return costs

    def best(self, rows: Indices, price: Floats, excess_price: float = OWN_EXCESS_PRICE) -> Best:
        found = Best(
            np.full(len(rows), np.inf),
            np.zeros(len(rows), dtype=np.intp),
            np.zeros((len(rows), self.interfaces), dtype=np.intp),
            np.full(len(rows), np.inf),
        )
        rank = np.full(len(rows), np.inf)
        owner = np.arange(len(rows))
        priced = self._paths[rows]
        priced[:, :, :-1] += price[:, None, :]
        for branching in range(MAX_BRANCHINGS + 1):
            least, picks = self._relaxed(rows[owner], priced, price[owner], excess_price)
            excess = self._costs.excess(rows[owner], picks)
            paid = np.take_along_axis(price[owner], picks, 1).sum(axis=1)
            value = np.where(np.isinf(least), np.inf, self._costs.cost(rows[owner], picks) + paid)
            ranks = value + excess_price * excess
            order = np.argsort(ranks, kind="stable")
            firsts = order[np.unique(owner[order], return_index=True)[1]]
            better = firsts[ranks[firsts] < rank[owner[firsts]] - MIN_GAIN]
            at = owner[better]
            rank[at], found.value[at], found.excess[at], found.picks[at] = (
                ranks[better],
                value[better],
                excess[better],
                picks[better],
            )
            open_ = (excess > 0) & (least < rank[owner] - MIN_GAIN) & (branching < MAX_BRANCHINGS)
            open_ = _most_promising(open_, owner, least, max(MIN_OPEN, min(MAX_OPEN, MAX_OPEN_ALL // len(rows))))
            together = self._together(rows[owner], picks, excess_price)
            np.minimum.at(found.least, owner, least + np.where(open_, together, 0.0))
            if not open_.any():
                break
            priced, owner = self._kept_apart(rows, priced, owner, picks, open_)
        return found

    def _together(self, rows: Indices, picks: Indices, excess_price: float) -> Floats:
        """Return the minimum cost, beside the bound, of not separating the interfaces that are too many on a server:
        one more in excess, less the region that they share."""
        crowded = self._costs.crowded_server(rows, picks)
        waived = np.where(self._costs.region[rows, crowded] >= 0, min(RULE_PRICE, excess_price), 0.0)
        found: Floats = np.where(self._forced[rows] > 0, 0.0, excess_price - waived)
        return found

    def _kept_apart(
        self, rows: Indices, priced: Floats, owner: Indices, picks: Indices, which: NDArray[np.bool_]
    ) -> tuple[Floats, Indices]:
        """Branch once for each interface on a crowded server: that one may not go there."""
        nodes = np.flatnonzero(which)
        crowded = self._costs.crowded_server(rows[owner[nodes]], picks[nodes])
        node, interface = np.nonzero(picks[nodes] == crowded[:, None])
        apart = priced[nodes[node]]
        apart[np.arange(len(node)), interface, crowded[node]] = np.inf
        return apart, owner[nodes[node]]

    def _relaxed(self, rows: Indices, priced: Floats, price: Floats, excess_price: float) -> tuple[Floats, Indices]:
        """Return the value of the best pattern, with the block's unavoidable excess, and its servers, some of which may
        have to be kept apart."""
        of_groups = self._groups.priced(rows, priced)
        least = np.empty(len(rows))
        pattern = np.empty(len(rows), dtype=np.intp)
        # Two copies that crowd a server need not pay for the region that they share.
        spared = max(0.0, RULE_PRICE - excess_price)
        for begin in range(0, len(rows), ROWS_AT_ONCE):
            part = slice(begin, begin + ROWS_AT_ONCE)
            values: Floats = of_groups[part, 0]
            for interface in range(1, self.interfaces):
                values = (values[:, :, None] + of_groups[part, interface, None, :]).reshape(len(values), -1)
            values = values + self._pattern_cost[rows[part]]
            if spared and self._shared is not None:
                values -= spared * np.maximum(0, self._shared[rows[part]])
            pattern[part] = values.argmin(axis=1)
            least[part] = values[np.arange(len(values)), pattern[part]]
        picks = self._groups.servers(rows, priced, self._classes[pattern])
        if self._may_cap.any():
            capped = self._capped(rows, of_groups, price, min(RULE_PRICE, excess_price))
            least = np.where(self._may_cap[rows], np.minimum(least, capped), least)
        waived = np.where((self._costs.region[rows] >= 0).any(axis=1), min(RULE_PRICE, excess_price), 0.0)
        return least + self._groups.floor[rows] + self._forced[rows] * (excess_price - waived), picks

    def _capped(self, rows: Indices, of_groups: Floats, price: Floats, rule_price: float) -> Floats:
        """Return the minimum cost of a choice in which only a single path, or a pair of paths, counts."""
        cheapest = np.where(self._least_copies[rows] < self.interfaces, 0.0, price[:, : self.servers].min(axis=1))
        least = of_groups.min(axis=(1, 2)) + (self.interfaces - 1) * cheapest
        for (i, k), table in self._lifts.items():
            both = of_groups[:, i, :, None] + of_groups[:, k, None, :] + table[rows]
            least = np.minimum(least, both.min(axis=(1, 2)) + (self.interfaces - 2) * cheapest)
        found: Floats = least + rule_price * self._least_shared[rows]
        return found

    def near(self, row: int, price: Floats, margin: float, at_most: int) -> Near:
        priced = self._costs.of_path[row] + price
        # The best is always included: it separates interfaces that share a cheapest server.
        best = self.best(np.array([row]), price[None]).picks
        picks = np.unique(np.concatenate([best, self._near_picks(row, priced, at_most)]), axis=0)
        rows = np.full(len(picks), row)
        values = self._costs.cost(rows, picks) + price[picks].sum(axis=1)
        return nearest(values, self._costs.excess(rows, picks), picks, margin, at_most, complete=False)

    def _near_picks(self, row: int, priced: Floats, at_most: int) -> Indices:
        """For each set of interfaces that may carry the copies, return every way to take one of the cheapest servers of
        each. If there are too many sets, use those of the cheapest interfaces."""
        tried = min(MAX_LISTED_CHOICES, TRIED_A_CHOICE * at_most)
        ways = self._ways(row, priced, tried)
        share = max(1, min(self.servers, max(tried_of_each(len(way), at_most) for way in ways)))
        while share > 1 and sum(share ** len(way) for way in ways) > tried:
            share -= 1
        cheapest = np.argsort(priced[:, : self.servers], axis=1, kind="stable")[:, :share]
        found = []
        for way in ways:
            of_way = np.full((share ** len(way), self.interfaces), self.servers, dtype=np.intp)
            chosen = combinations(len(way), share)
            of_way[:, way] = cheapest[way, chosen]
            found.append(of_way)
        return np.concatenate(found)

    def _ways(self, row: int, priced: Floats, at_most: int) -> list[list[int]]:
        """Return the sets of interfaces that may carry copies; if too many, the cheapest of each size."""
        sizes = range(max(1, int(self._least_copies[row])), int(self._most_copies[row]) + 1)
        if sum(math.comb(self.interfaces, size) for size in sizes) <= at_most:
            return [list(way) for size in sizes for way in itertools.combinations(range(self.interfaces), size)]
        order = np.argsort(priced[:, : self.servers].min(axis=1), kind="stable").tolist()
        return [sorted(order[:size]) for size in sizes]


def _most_promising(open_: NDArray[np.bool_], owner: Indices, least: Floats, at_most: int) -> NDArray[np.bool_]:
    """Mark for each owner the `at_most` open ones of least value."""
    nodes = np.flatnonzero(open_)
    if len(nodes) <= at_most:
        return open_
    nodes = nodes[np.lexsort((least[nodes], owner[nodes]))]
    _, first, count = np.unique(owner[nodes], return_index=True, return_counts=True)
    rank = np.arange(len(nodes)) - np.repeat(first, count)
    found = np.zeros_like(open_)
    found[nodes[rank < at_most]] = True
    return found
