"""Finds the pair of an interface and a server, besides the mapped ones, of which a few requests would teach most.

The knowledge gradient (Frazier, Powell and Dayanik 2008): by how much the better of two epsilons, the mapped one and
the other one, is expected to improve through the results of some more trials of the other one. It is small for a pair
that is known well, and for one so bad that a few trials would hardly change that.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from plr.controlplane.core.problem.plan import choice_of
from plr.protos.model.mapping import Assignment

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.controlplane.core.problem.plan import BlockPlan, Plan
    from plr.controlplane.core.problem.problem import Block, BlockKey, Choice, Problem
    from plr.protos.model.ids import InterfaceName, NodeName

TRIALS = 6.0
"""What a robot that explores sends within half a minute or more."""

WORTH_KNOWING = 1e-4
"""An expected gain below this is not worth a request."""

STAYS = 0.5
"""The explored pair stays until another one promises twice as much: each new pair is a new mapping."""


class _Kept(NamedTuple):
    """What was decided, and on what grounds."""

    block: Block
    assignments: tuple[tuple[InterfaceName, NodeName], ...]
    pair: Assignment | None


class ExploredPairs:
    """What each block explores, from one solution to the next."""

    def __init__(self) -> None:
        self._kept: dict[BlockKey, _Kept] = {}

    def update(self, problem: Problem, plan: Plan) -> dict[BlockKey, Assignment]:
        """Return the pairs to explore besides this plan, by block; those of unchanged blocks stay."""
        self._kept = {block.key: self._look(block, plan.blocks[block.key]) for block in problem.blocks}
        return {key: kept.pair for key, kept in self._kept.items() if kept.pair is not None}

    def _look(self, block: Block, plan: BlockPlan) -> _Kept:
        before = self._kept.get(block.key)
        if before is not None and before.block is block and before.assignments == plan.assignments:
            return before
        pair = most_instructive(block, plan, before.pair if before is not None else None)
        return _Kept(block, plan.assignments, pair)


def most_instructive(block: Block, plan: BlockPlan, before: Assignment | None) -> Assignment | None:
    """Return the pair to explore, None if none is worth it; `before` is the one explored so far."""
    choice = choice_of(block, plan) if block.idempotent and block.weights else None
    if choice is None:
        return None
    gains = dict(_gains(block, choice))
    best = max(gains, key=lambda pair: gains[pair], default=None)
    if best is None or gains[best] < WORTH_KNOWING:
        return None
    if before is not None and gains.get(before, 0.0) >= max(WORTH_KNOWING, STAYS * gains[best]):
        return before
    return best


def _gains(block: Block, choice: Choice) -> Iterator[tuple[Assignment, float]]:
    chosen = [block.epsilon[i][j] for i, j in enumerate(choice) if j is not None]
    worst = max((epsilon for epsilon in chosen if epsilon is not None), default=1.0)
    for i, (interface, mapped) in enumerate(zip(block.interfaces, choice, strict=True)):
        rival = block.epsilon[i][mapped] if mapped is not None else worst
        for j, server in enumerate(block.servers):
            epsilon = block.epsilon[i][j]
            if j != mapped and epsilon is not None and rival is not None:
                yield Assignment(interface, server), knowledge_gradient(rival, epsilon, block.weights[i][j])


def knowledge_gradient(rival: float, mean: float, weight: float) -> float:
    """Return the expected gain of `TRIALS` more trials of Beta(mean x weight, ...) against an exactly known rival
    (normal approximation)."""
    spread = math.sqrt(mean * (1.0 - mean) / (weight + 1.0) * TRIALS / (TRIALS + weight))
    if spread <= 0.0:
        return 0.0
    z = abs(rival - mean) / spread
    density = math.exp(-z * z / 2.0) / math.sqrt(2.0 * math.pi)
    return spread * (density - z * math.erfc(z / math.sqrt(2.0)) / 2.0)
