"""Computes what choices of many blocks of one shape cost, in arrays: for blocks without a target.

A choice names for each interface a server, or none by the number after the last server.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from plr.controlplane.core.problem.costs import RULE_PRICE
from plr.controlplane.core.problem.domains import beyond, chooses_interfaces, has_shared_regions, numbered, repeats
from plr.controlplane.core.problem.objectives import PROBABILITY_FLOOR, cost_of_none, epsilon_matrix, path_costs
from plr.controlplane.core.problem.problem import Objective

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from plr.controlplane.core.problem.problem import Block

    Floats = NDArray[np.float64]
    Indices = NDArray[np.intp]


class StackedCosts:
    """The costs of the choices of blocks with equally many interfaces."""

    def __init__(self, objective: Objective, blocks: Sequence[Block], servers: int) -> None:
        rows, interfaces = len(blocks), len(blocks[0].interfaces)
        self._none = servers
        self.of_path: Floats = np.full((rows, interfaces, servers + 1), np.inf)
        """By block, interface and server: what a path adds while lifts are 1; infinite if there is no path, and for an
        interface without a copy if each must carry one."""
        self.region: Indices = np.full((rows, servers + 1), -1)
        """By block and server: the region's number; -1 if it is unknown or copies need not care."""
        self._carrier: Indices = np.full((rows, interfaces), -1)
        self._capacity = np.array([block.capacity or interfaces for block in blocks])
        for row, block in enumerate(blocks):
            self.of_path[row, :, : len(block.servers)] = path_costs(objective, epsilon_matrix(block))
            if chooses_interfaces(block):
                self.of_path[row, :, servers] = cost_of_none(objective)
                if block.carriers:
                    self._carrier[row] = numbered(block.carriers)
            if has_shared_regions(block):
                self.region[row, : len(block.servers)] = numbered(block.regions)
        self.has_lifts = objective is Objective.JOINT and any(block.lifts for block in blocks)
        if self.has_lifts:
            self._keep_lifts(blocks)

    def _keep_lifts(self, blocks: Sequence[Block]) -> None:
        keys = [(row, *one, *two) for row, block in enumerate(blocks) for one, two in block.lifts]
        lifts = [lift for block in blocks for lift in block.lifts.values()]
        row, i, j, k, m = np.array(keys, dtype=np.intp).T
        codes = self._code(row, i, j, k, m)
        order = np.argsort(codes)
        self._codes = codes[order]
        self._log_lifts = np.log(np.maximum(np.array(lifts)[order], PROBABILITY_FLOOR))

    def _code(self, row: Indices, i: Indices | int, j: Indices, k: Indices | int, m: Indices) -> Indices:
        interfaces = self.of_path.shape[1]
        found: Indices = (((row * interfaces + i) * interfaces + k) * (self._none + 1) + j) * (self._none + 1) + m
        return found

    def log_lifts(self, row: Indices, i: int, j: Indices, k: int, m: Indices) -> Floats:
        """Return the log lifts of pairs of paths, (i, j) and (k, m) with i < k; the arrays broadcast as in numpy."""
        wanted = self._code(row, i, j, k, m)
        at = np.minimum(np.searchsorted(self._codes, wanted), len(self._codes) - 1)
        found: Floats = np.where(self._codes[at] == wanted, self._log_lifts[at], 0.0)
        return found

    def excess(self, rows: Indices, picks: Indices) -> Indices:
        """Return by how many interfaces these choices, one for each row, exceed the blocks' own capacities."""
        return repeats(np.where(picks == self._none, -1, picks), self._capacity[rows])

    def crowded_server(self, rows: Indices, picks: Indices) -> Indices:
        """Return for each choice a server that carries too many of its interfaces."""
        crowd = beyond(np.where(picks == self._none, -1, picks), self._capacity[rows])
        found: Indices = picks[np.arange(len(picks)), crowd.argmax(axis=1)]
        return found

    def cost(self, rows: Indices, picks: Indices) -> Floats:
        """Return `costs.block_cost` of these choices, one for each row; infinite if a path does not exist."""
        singles = np.take_along_axis(self.of_path[rows], picks[:, :, None], 2)[:, :, 0]
        total: Floats = singles.sum(axis=1)
        if self.has_lifts:
            cap = singles.min(axis=1)
            for i, k in itertools.combinations(range(picks.shape[1]), 2):
                lift = self.log_lifts(rows, i, picks[:, i], k, picks[:, k])
                total = total + lift
                cap = np.minimum(cap, singles[:, i] + singles[:, k] + lift)
            total = np.where(np.isinf(total), np.inf, np.minimum(total, cap))
        return total + RULE_PRICE * self._violations(rows, picks)

    def _violations(self, rows: Indices, picks: Indices) -> Indices:
        there = picks != self._none
        crowd = beyond(np.where(there, picks, -1), self._capacity[rows])
        regions = np.where(crowd, -1, np.take_along_axis(self.region[rows], picks, 1))
        return repeats(regions, np.array(1)) + repeats(np.where(there, self._carrier[rows], -1), np.array(1))

    def carriers_shared(self, there: NDArray[np.bool_]) -> Indices:
        """Return by block, then by row of `there` (which interfaces carry a copy), how many share a carrier."""
        return repeats(np.where(there, self._carrier[:, None, :], -1), np.array(1))
