"""Computes how likely one choice of paths is better than another, given how well each path's epsilon is known."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from plr.controlplane.core.problem.costs import TARGET_TOLERANCE, block_cost
from plr.controlplane.core.problem.objectives import PROBABILITY_FLOOR, joint_miss
from plr.controlplane.core.problem.problem import Objective

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from plr.controlplane.core.problem.problem import Block, Choice, PairIndex

DRAWS = 128
"""Draws of every unknown epsilon: the resulting probability is accurate to 0.05."""

_SEED = 1
"""Seed of the draws, the same each time, so that what did not change is not judged differently."""


def probability_better(objective: Objective, changes: Iterable[tuple[Block, Choice, Choice]]) -> float:
    """Return the probability that all blocks together cost less with the first choice of each than with the second.

    The epsilons of the paths that only one of the two uses are drawn from their Beta distributions. Rare misses make
    these so skewed that a number of standard deviations would mean little. Paths that both use, and lifts, keep their
    expected values.
    """
    rng = np.random.default_rng(_SEED)
    saved = np.zeros(DRAWS)
    for block, new, old in changes:
        saved += block_cost(objective, block, old) - block_cost(objective, block, new)
        ours, theirs = _paths(new), _paths(old)
        for path in sorted(theirs - ours):
            saved += _off_mean(objective, block, path, rng)
        for path in sorted(ours - theirs):
            saved -= _off_mean(objective, block, path, rng)
    return float(np.mean((saved > 0.0) + 0.5 * (saved == 0.0)))


def probability_met(block: Block, choice: Choice) -> float:
    """Return the probability that a choice keeps its block's target, with the epsilons of its paths drawn likewise."""
    if block.target is None:
        return 1.0
    rng = np.random.default_rng(_SEED)
    log_miss = np.full(DRAWS, math.log(joint_miss(block, choice)))
    for path in sorted(_paths(choice)):
        log_miss += _off_mean(Objective.JOINT, block, path, rng)
    return float(np.mean(log_miss <= math.log(block.target.miss) + TARGET_TOLERANCE))


def _paths(choice: Choice) -> set[PairIndex]:
    return {(interface, server) for interface, server in enumerate(choice) if server is not None}


def _off_mean(objective: Objective, block: Block, path: PairIndex, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return by how much more than expected a path costs, in each draw."""
    estimate = block.estimate(path)
    if estimate is None:
        return np.zeros(DRAWS)
    drawn = rng.beta(estimate.misses, estimate.hits, DRAWS)
    if objective is Objective.SUM:
        return drawn - estimate.mean
    drawn = np.maximum(drawn, PROBABILITY_FLOOR)
    return np.log(drawn / max(estimate.mean, PROBABILITY_FLOOR))
