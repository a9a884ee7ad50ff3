"""Computes the total cost of a block's choice: objective, failure domains, and for a block with a target its charges.

As reliable as possible:

    RULE_PRICE x violations + what the objective says

With a target, p being the probability that all copies miss and n the number of interfaces:

    p <= target    RULE_PRICE x violations + charge / largest charge + TIE_PRICE x log p
    p > target     RULE_PRICE x (4 n + violations + copies left out) + log(p / target)

So a choice that meets the target comes before all that do not, one that shares no domain before those that do, and then
the cheaper one; of equally cheap ones the more reliable. If none meets the target, a copy left out counts as much as
one that shares a domain, and then the most reliable choice is taken. The largest charge is that of a copy over every
interface to its dearest server: so the other terms beside RULE_PRICE are comparable between robots.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from plr.controlplane.core.problem.domains import violation_counts, violations
from plr.controlplane.core.problem.objectives import LEAST_POSITIVE, joint_miss, objective_cost, objective_costs
from plr.controlplane.core.problem.problem import Objective

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from plr.controlplane.core.problem.problem import Block, Choice, Target

    Floats = NDArray[np.float64]

RULE_PRICE = 2000.0
"""Price of one violation: more than any two choices differ by in the objective, as no logarithm is below that of
LEAST_POSITIVE (-708)."""

TIE_PRICE = 1e-6
"""Price of the logarithm of the miss probability if charges decide: these count as equal within 0.1 % of the
largest."""

TARGET_TOLERANCE = 1e-9
"""Share by which a miss probability may exceed the target and still meet it: rounding."""

TARGET_FLOOR = TIE_PRICE * math.log(LEAST_POSITIVE)
"""Minimum cost of any choice of a block with a target."""


def block_cost(objective: Objective, block: Block, choice: Choice) -> float:
    """Return the block's share of what is minimised."""
    shared = violations(block, choice)
    if block.target is None:
        return RULE_PRICE * shared + objective_cost(objective, block, choice)
    log_miss = math.log(joint_miss(block, choice))
    if meets(block.target, log_miss):
        return RULE_PRICE * shared + charge(block.target, choice) / largest_charge(block) + TIE_PRICE * log_miss
    left_out = block.copies_wanted.most - sum(server is not None for server in choice)
    return RULE_PRICE * (4 * len(choice) + shared + left_out) + log_miss - math.log(block.target.miss)


def choice_costs(objective: Objective, block: Block, choices: NDArray[np.intp]) -> Floats:
    """Return `block_cost` of many choices, one per row, -1 where an interface has no copy; infinite over no path."""
    shared = RULE_PRICE * violation_counts(block, choices)
    if block.target is None:
        return shared + objective_costs(objective, block, choices)
    log_miss = objective_costs(Objective.JOINT, block, choices)
    log_target = math.log(block.target.miss)
    there = choices >= 0
    of_copies = np.array(block.target.charges)[np.arange(choices.shape[1]), choices]
    charges = np.where(there, of_copies, 0.0).sum(axis=1)
    left_out = block.copies_wanted.most - there.sum(axis=1)
    met = charges / largest_charge(block) + TIE_PRICE * log_miss
    missed = RULE_PRICE * (4 * choices.shape[1] + left_out) + log_miss - log_target
    total: Floats = shared + np.where(log_miss <= log_target + TARGET_TOLERANCE, met, missed)
    total[np.isinf(log_miss)] = np.inf
    return total


def meets(target: Target, log_miss: float) -> bool:
    """Return whether a miss probability, given as its logarithm, is within the target."""
    return log_miss <= math.log(target.miss) + TARGET_TOLERANCE


def charge(target: Target, choice: Choice) -> float:
    """Return what a request costs with all its copies."""
    return sum(row[server] for row, server in zip(target.charges, choice, strict=True) if server is not None)


def largest_charge(block: Block) -> float:
    """Return the charge of a copy over every interface to its dearest server; 1 if nothing costs anything."""
    return (sum(max(row) for row in block.target.charges) if block.target is not None else 0.0) or 1.0


def without_rules(costs: Floats) -> Floats:
    """Return the costs less what RULE_PRICE contributes: what the objective, or the charges, say."""
    return costs - RULE_PRICE * np.rint(costs / RULE_PRICE)
