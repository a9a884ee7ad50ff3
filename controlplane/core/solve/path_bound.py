"""Bounds the cost of a block's choices from below, path by path, when there are too many choices to list."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from plr.controlplane.core.problem.costs import RULE_PRICE, TARGET_FLOOR, TARGET_TOLERANCE, largest_charge
from plr.controlplane.core.problem.domains import least_violations
from plr.controlplane.core.problem.objectives import cost_of_none, epsilon_matrix, path_costs
from plr.controlplane.core.problem.problem import Objective
from plr.controlplane.core.solve.enumeration import lift_floor

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from plr.controlplane.core.problem.problem import Block, Target

    Floats = NDArray[np.float64]

RELIABILITY_PRICES = np.array([0.0, *(2.0**power for power in range(-9, 5))])
"""Prices of one unit of the logarithm of the miss probability, in shares of the largest charge: tried one by one."""


def path_bound(objective: Objective, block: Block) -> PathBound:
    """Return the bound for a block."""
    return PathBound(objective, block) if block.target is None else _TargetBound(block, block.target)


class PathBound:
    """The cost is at least the sum of the paths' own costs, what lifts below 1 take off, and the cost of copies that
    outnumber the domains.

    Each interface takes its cheapest server, and the number of copies is the allowed one that pays best.
    """

    def __init__(self, objective: Objective, block: Block) -> None:
        least, self._most = block.copies_wanted
        self._least = least if block.idempotent else 1
        self._costs = path_costs(objective, epsilon_matrix(block))
        self._none = cost_of_none(objective)
        self._shared = least_violations(block)
        self._rest = lift_floor(block) if objective is Objective.JOINT else 0.0

    def at(self, price: Floats, forced: int, excess_price: float) -> float:
        """Return the bound at these prices of the servers, and of an interface in excess beyond those `forced`."""
        interfaces, servers = self._costs.shape
        gains = (self._costs + price[:servers]).min(axis=1) - self._none
        # A copy that crowds a server shares no domain: the cheaper of the two counts.
        shared = min(RULE_PRICE, excess_price) * max(0, self._shared - forced)
        return float(self._none * interfaces + self._sum(gains) + self._rest + shared)

    def _sum(self, gains: Floats) -> Floats:
        """Return the least sum, along the last dimension, over the allowed numbers of copies."""
        ordered = np.sort(gains)
        always = ordered[..., : self._least].sum(axis=-1)
        total: Floats = always + np.minimum(ordered[..., self._least : self._most], 0.0).sum(axis=-1)
        return total


class _TargetBound(PathBound):
    """Bound of a block with a target: a Lagrangian relaxation, or, if no set of paths can meet the target, the minimum
    cost of missing it."""

    def __init__(self, block: Block, target: Target) -> None:
        super().__init__(Objective.JOINT, block)
        charges = np.array(target.charges) / largest_charge(block)
        self._charges = np.where(np.isinf(self._costs), np.inf, charges)
        self._logs = np.where(np.isinf(self._costs), 0.0, self._costs)
        # What the paths' logarithms must sum to for the target to be met.
        self._enough = math.log(target.miss) + TARGET_TOLERANCE - self._rest
        self._missed = RULE_PRICE * 4 * len(block.interfaces)
        best = float(self._sum(self._costs.min(axis=1)))
        self._meets = best <= self._enough
        if not self._meets:
            self._missed += best - self._enough

    def at(self, price: Floats, forced: int, excess_price: float) -> float:
        servers = self._costs.shape[1]
        paid = np.where(np.isinf(self._costs), np.inf, price[:servers])
        missed = self._missed + float(self._sum(paid.min(axis=1)))
        if not self._meets:
            return missed
        costs = self._charges + price[:servers] + RELIABILITY_PRICES[:, None, None] * self._logs
        met = self._sum(costs.min(axis=2)) - RELIABILITY_PRICES * self._enough
        return min(float(met.max()) + TARGET_FLOOR, missed)
