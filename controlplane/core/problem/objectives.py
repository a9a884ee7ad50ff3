"""Computes what a block's choice costs under each objective; what else counts is in `costs`.

With S the chosen pairs (i, j) of a block:

- `sum`: the sum of epsilon_ij, and 1 for an interface without a copy.
- `product`: the sum of log epsilon_ij.
- `joint`: the logarithm of `joint_miss`.

Minimising the sum of logarithms over all blocks asks the same relative gain of every robot: making one robot's miss
probability ten times smaller is worth as much as making another's ten times smaller.
"""

from __future__ import annotations

import itertools
import math
import sys
from typing import TYPE_CHECKING

import numpy as np

from plr.controlplane.core.problem.problem import Objective

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from plr.controlplane.core.problem.problem import Block, Choice

PROBABILITY_FLOOR = 1e-9
"""Smaller probabilities and lifts count as this, so that their logarithms are finite: no posterior mean over less than
a billion requests is smaller."""

LEAST_POSITIVE = sys.float_info.min
"""Lower limit for a product of very many paths, so that it has a logarithm."""


def objective_cost(objective: Objective, block: Block, choice: Choice) -> float:
    """Return what a choice of a block costs by itself."""
    if objective is Objective.JOINT:
        return math.log(joint_miss(block, choice))
    chosen = [row[server] for row, server in zip(block.epsilon, choice, strict=True) if server is not None]
    epsilons = [epsilon for epsilon in chosen if epsilon is not None]
    if objective is Objective.SUM:
        return sum(epsilons) + (len(choice) - len(epsilons))
    return sum(math.log(max(epsilon, PROBABILITY_FLOOR)) for epsilon in epsilons)


def joint_miss(block: Block, choice: Choice) -> float:
    """Return the probability that all chosen paths miss; 1 without any.

    It is the product of their epsilons and of the lifts of all their pairs: exact for two paths. For more it is a
    guess, so it never exceeds what one pair or one path of the set allows.
    """
    paths = [(i, j) for i, j in enumerate(choice) if j is not None]
    epsilon = {(i, j): max(block.epsilon[i][j] or 0.0, PROBABILITY_FLOOR) for i, j in paths}
    total = math.prod(epsilon.values())
    if not block.lifts:
        return max(total, LEAST_POSITIVE)
    cap = min(epsilon.values(), default=1.0)
    for one, two in itertools.combinations(paths, 2):
        lift = max(block.lifts.get((one, two), 1.0), PROBABILITY_FLOOR)
        total *= lift
        cap = min(cap, epsilon[one] * epsilon[two] * lift)
    return max(min(total, cap), LEAST_POSITIVE)


def log_lift(lift: float) -> float:
    """Return the logarithm of a lift, finite."""
    return math.log(max(lift, PROBABILITY_FLOOR))


def epsilon_matrix(block: Block) -> NDArray[np.float64]:
    """Return the epsilons by interface, then server; NaN where there is no path."""
    return np.array(block.epsilon, dtype=np.float64)


def path_costs(objective: Objective, epsilon: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what each path adds to the cost while lifts are 1; infinite where there is no path."""
    costs = epsilon if objective is Objective.SUM else np.log(np.maximum(epsilon, PROBABILITY_FLOOR))
    return np.where(np.isnan(epsilon), np.inf, costs)


def cost_of_none(objective: Objective) -> float:
    """Return what an interface without a copy adds to the cost."""
    return 1.0 if objective is Objective.SUM else 0.0


def objective_costs(objective: Objective, block: Block, choices: NDArray[np.intp]) -> NDArray[np.float64]:
    """Return `objective_cost` of many choices, one per row, with -1 where an interface carries no copy; infinite if a
    path does not exist."""
    epsilon = epsilon_matrix(block)
    if objective is Objective.JOINT:
        return _joint_costs(block, epsilon, choices)
    total: NDArray[np.float64] = _of_paths(objective, epsilon, choices).sum(axis=1)
    return total


def _of_paths(objective: Objective, epsilon: NDArray[np.float64], choices: NDArray[np.intp]) -> NDArray[np.float64]:
    costs = path_costs(objective, epsilon)
    rows = np.arange(epsilon.shape[0])
    return np.where(choices < 0, cost_of_none(objective), costs[rows, choices])


def _joint_costs(block: Block, epsilon: NDArray[np.float64], choices: NDArray[np.intp]) -> NDArray[np.float64]:
    singles = _of_paths(Objective.JOINT, epsilon, choices)
    total: NDArray[np.float64] = singles.sum(axis=1)
    if not block.lifts:
        return total
    cap = singles.min(axis=1)
    of_pairs = _lifts_of_pairs(block, epsilon.shape[1])
    for i, k in itertools.combinations(range(epsilon.shape[0]), 2):
        both = singles[:, i] + singles[:, k]
        if (i, k) in of_pairs:
            codes, logs = of_pairs[i, k]
            there = (choices[:, i] >= 0) & (choices[:, k] >= 0)
            wanted = np.where(there, choices[:, i] * epsilon.shape[1] + choices[:, k], -1)
            at = np.minimum(np.searchsorted(codes, wanted), len(codes) - 1)
            lift = np.where(codes[at] == wanted, logs[at], 0.0)
            total = total + lift
            both = both + lift
        cap = np.minimum(cap, both)
    return np.where(np.isinf(total), np.inf, np.minimum(total, cap))


def _lifts_of_pairs(block: Block, servers: int) -> dict[tuple[int, int], tuple[NDArray[np.intp], NDArray[np.float64]]]:
    """Return by pair of interfaces the codes of the two servers, ascending, and the logarithms of their lifts.

    A table of all interfaces and servers could become arbitrarily large: a robot may name hundreds of interfaces.
    """
    lifts: dict[tuple[int, int], list[tuple[int, float]]] = {}
    for ((i, j), (k, m)), lift in block.lifts.items():
        lifts.setdefault((i, k), []).append((j * servers + m, log_lift(lift)))
    found = {}
    for pair, entries in lifts.items():
        codes, logs = zip(*sorted(entries), strict=True)
        found[pair] = np.array(codes, dtype=np.intp), np.array(logs)
    return found
