"""Groups servers that are alike to a block except for what the paths to them cost.

For each interface the servers fall into groups. A *single* holds one server whose paths have lifts, or stands for no
copy; a *multi* holds all other servers of one region, or those whose region does not matter. A pattern is a group for
each interface. Which server of a group is taken depends on paths' costs and prices alone, so a block's best choice is
found among some hundred patterns instead of millions of choices.

If there would be too many patterns, regions and lifts of the less promising servers are ignored: this only makes a
pattern cheaper than its choices, by `floor` at most.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from plr.controlplane.core.problem.domains import beyond, chooses_interfaces
from plr.controlplane.core.problem.objectives import log_lift
from plr.controlplane.core.solve.enumeration import combinations

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from plr.controlplane.core.problem.problem import Block
    from plr.controlplane.core.solve.batch_costs import StackedCosts

    Floats = NDArray[np.float64]
    Indices = NDArray[np.intp]

ROWS_AT_ONCE = 256
"""Blocks whose patterns are computed together: their arrays should fit the processor's cache."""


class ServerGroups:
    """The groups of blocks with equally many interfaces, at most `at_most` of them for an interface."""

    def __init__(self, blocks: Sequence[Block], costs: StackedCosts, at_most: int) -> None:
        rows, interfaces, columns = costs.of_path.shape
        none = columns - 1
        choosing = [chooses_interfaces(block) for block in blocks]
        lifted = [_lifted(block) if costs.has_lifts else [list[int]()] * interfaces for block in blocks]
        regions = [_regions(block, costs.region[row]) for row, block in enumerate(blocks)]
        left = max(1, at_most - any(choosing))
        most_regions = max(map(len, regions))
        # A shared region costs more than all lifts together, so regions come first.
        apart = all(bool((costs.region[row, : len(block.servers)] >= 0).all()) for row, block in enumerate(blocks))
        if most_regions + (not apart) > left:
            most_regions, apart = left - 1, False
        most_lifted = max(len(servers) for of_block in lifted for servers in of_block)
        singles = min(most_lifted, left - most_regions - (not apart))
        self.none = none
        self.single: Indices = np.full((rows, interfaces, singles + any(choosing)), columns)
        """By block and interface: the servers that are groups by themselves; the number after that of no copy stands
        for no server at all."""
        self.multi: Indices = np.zeros((rows, interfaces, columns), dtype=np.intp)
        """By block, interface and server: the number of the multi; -1 in a single."""
        self.floor: Floats = np.zeros(rows)
        self._region: Indices = np.full((rows, most_regions + (not apart)), -1)
        for row, block in enumerate(blocks):
            kept = regions[row][:most_regions]
            self._region[row, : len(kept)] = kept
            self.multi[row] = most_regions
            for number, region in enumerate(kept):
                self.multi[row, :, costs.region[row] == region] = number
            for i, servers in enumerate(lifted[row]):
                self.single[row, i, : len(servers[:singles])] = servers[:singles]
                self.multi[row, i, servers[:singles]] = -1
            if choosing[row]:
                self.single[row, :, -1] = none
            self.multi[row, :, none] = -1
            if any(len(servers) > singles for servers in lifted[row]):
                self.floor[row] = _floor(block, [set(servers[:singles]) for servers in lifted[row]])
        self.multis = self._region.shape[1]
        self.count = self.single.shape[2] + self.multis
        """Number of groups of each interface: first the singles, then the multis."""

    def priced(self, rows: Indices, priced: Floats) -> Floats:
        """Return each group's least path cost, by block, interface and group. `priced` has a last column that is
        infinite."""
        multi = self.multi[rows]
        of_multis = [np.where(multi == number, priced[:, :, :-1], np.inf).min(axis=2) for number in range(self.multis)]
        of_singles = np.take_along_axis(priced, self.single[rows], 2)
        found: Floats = np.concatenate([of_singles, np.stack(of_multis, axis=2)], axis=2)
        return found

    def servers(self, rows: Indices, priced: Floats, chosen: Indices) -> Indices:
        """Return the servers with these least costs in the chosen groups, by block and interface."""
        singles = self.single.shape[2]
        in_multi = self.multi[rows] == (chosen - singles)[:, :, None]
        cheapest: Indices = np.where(in_multi, priced[:, :, :-1], np.inf).argmin(axis=2)
        if not singles:
            return cheapest
        alone = np.take_along_axis(self.single[rows], np.minimum(chosen, singles - 1)[:, :, None], 2)[:, :, 0]
        found: Indices = np.where(chosen < singles, np.minimum(alone, self.none), cheapest)
        return found

    def region_of(self, costs: StackedCosts) -> Indices:
        """Return the number of each group's region, or -1, by block, interface and group."""
        rows, interfaces, _ = self.single.shape
        of_server = np.append(costs.region, np.full((rows, 1), -1), axis=1)
        of_single = of_server[np.arange(rows)[:, None, None], self.single]
        of_multi = np.broadcast_to(self._region[:, None, :], (rows, interfaces, self.multis))
        found: Indices = np.concatenate([of_single, of_multi], axis=2)
        return found


def violations(blocks: Sequence[Block], costs: StackedCosts, groups: ServerGroups) -> NDArray[np.int16]:
    """Return how many copies share a domain, by block and pattern; -1 if the block may not have that many copies."""
    rows, interfaces, _ = groups.single.shape
    patterns = combinations(interfaces, groups.count)
    found = np.zeros((rows, len(patterns)), dtype=np.int16)
    none = groups.single.shape[2] - 1
    of_region = groups.region_of(costs)
    for begin in range(0, rows, ROWS_AT_ONCE):
        part = slice(begin, begin + ROWS_AT_ONCE)
        labels = of_region[part][:, np.arange(interfaces), patterns]
        if (labels >= 0).any():
            found[part] += beyond(labels, np.array(1)).sum(axis=2, dtype=np.int16)
    if any(chooses_interfaces(block) for block in blocks):
        there = patterns != none
        copies = there.sum(axis=1)
        found += costs.carriers_shared(there).astype(np.int16)
        for row, block in enumerate(blocks):
            least, most = block.copies_wanted
            if chooses_interfaces(block):
                found[row, (copies < max(1, least)) | (copies > most)] = -1
    return found


def _lifted(block: Block) -> list[list[int]]:
    """Return by interface the servers whose paths have lifts, the most promising first."""
    found: list[set[int]] = [set() for _ in block.interfaces]
    for (i, j), (k, m) in block.lifts:
        found[i].add(j)
        found[k].add(m)
    return [
        sorted(servers, key=lambda j: (row[j] or 0.0, j)) for servers, row in zip(found, block.epsilon, strict=True)
    ]


def _regions(block: Block, region: Indices) -> list[int]:
    """Return the numbers of the known regions, that of the most promising server first."""
    if (region < 0).all():
        return []
    best = np.nanmin(np.array(block.epsilon, dtype=np.float64), axis=0, initial=1.0)
    order = np.argsort(best, kind="stable")
    return [number for number in dict.fromkeys(region[order].tolist()) if number >= 0]


def _floor(block: Block, singles: list[set[int]]) -> float:
    """Return the least that lifts not between singles add to a choice's cost."""
    least: dict[tuple[int, int], float] = {}
    for ((i, j), (k, m)), lift in block.lifts.items():
        if j not in singles[i] or m not in singles[k]:
            least[i, k] = min(least.get((i, k), 0.0), log_lift(lift))
    return sum(least.values())
