"""Assigns interfaces to servers at the least cost, each server taking a few: the assignment problem proper.

Shortest augmenting paths with potentials (Kuhn's Hungarian method in Jonker and Volgenant's order): for one row after
the other, the cheapest way to make room is found.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from plr.controlplane.core.problem.domains import repeats
from plr.controlplane.core.problem.objectives import epsilon_matrix
from plr.controlplane.core.problem.problem import reachable

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from plr.controlplane.core.problem.problem import Block

NO_PATH_COST = 1e12
"""Stands for infinity, which the method cannot subtract."""


def cheapest_matching(costs: NDArray[np.float64], slots: int, excess_price: float) -> list[int]:
    """Return each interface's server; `slots` interfaces fit a server, and each further one costs `excess_price`."""
    interfaces, servers = costs.shape
    finite = np.where(np.isinf(costs), NO_PATH_COST, costs)
    within = min(slots, interfaces)
    wide = np.hstack([finite] * within + [finite + excess_price] * (interfaces - within))
    return [column % servers for column in cheapest_columns(wide)]


def forced_excess(block: Block) -> int:
    """Return by how many interfaces a block at least exceeds its own capacity."""
    interfaces = len(block.interfaces)
    if not block.capacity or min(len(reachable(row)) for row in block.epsilon) * block.capacity >= interfaces:
        return 0
    costs = np.where(np.isnan(epsilon_matrix(block)), np.inf, 0.0)
    servers = cheapest_matching(costs, block.capacity, 1.0)
    beyond = int(repeats(np.array(servers), np.array(block.capacity)))
    return max(0, beyond - (interfaces - block.copies_wanted.least))


def cheapest_columns(costs: NDArray[np.float64]) -> list[int]:
    """Assign each row a column of its own at the least sum; there are no fewer columns than rows."""
    rows, columns = costs.shape
    row_potential, column_potential = np.zeros(rows), np.zeros(columns)
    row_of = np.full(columns, -1)
    for row in range(rows):
        distance = costs[row] - row_potential[row] - column_potential
        came_from = np.full(columns, -1)
        done = np.zeros(columns, dtype=np.bool_)
        while True:
            column = int(np.where(done, np.inf, distance).argmin())
            nearest = distance[column]
            if row_of[column] < 0:
                break
            done[column] = True
            other = int(row_of[column])
            through = nearest + costs[other] - row_potential[other] - column_potential
            shorter = ~done & (through < distance)
            distance[shorter] = through[shorter]
            came_from[shorter] = column
        settled = np.flatnonzero(done)
        row_potential[row] += nearest
        row_potential[row_of[settled]] += nearest - distance[settled]
        column_potential[settled] -= nearest - distance[settled]
        while came_from[column] >= 0:
            before = int(came_from[column])
            row_of[column] = row_of[before]
            column = before
        row_of[column] = row
    found = [0] * rows
    for taken in np.flatnonzero(row_of >= 0).tolist():
        found[row_of[taken]] = taken
    return found
