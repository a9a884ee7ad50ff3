"""What a plan for the assignment problem says, and what it costs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from controlplane.core.objectives import block_cost, joint_miss
from controlplane.core.problem import block_excess, fleet_excess, is_valid

if TYPE_CHECKING:
    from collections.abc import Mapping

    from controlplane.core.problem import Block, BlockKey, Choice, FleetKey, Problem
    from protos.model import InterfaceName, NodeName


@dataclass(frozen=True, slots=True)
class BlockPlan:
    """Where one block's requests go."""

    key: BlockKey
    assignments: tuple[tuple[InterfaceName, NodeName], ...]
    cost: float
    """The block's share of what is minimised, see `objectives`."""
    predicted_miss: float
    """Probability that all copies miss, see `objectives.joint_miss`."""
    excess: int = 0
    """By how many interfaces the block's own capacity is exceeded."""
    why: str = ""
    """What made it change last; empty if it never did."""
    block: Block | None = field(default=None, compare=False, repr=False)
    choice: Choice = field(default=(), compare=False, repr=False)
    """What it was made from."""


@dataclass(frozen=True, slots=True)
class Plan:
    """A plan for a problem."""

    blocks: Mapping[BlockKey, BlockPlan]
    fleet_excess: Mapping[FleetKey, int] = field(default_factory=dict)
    """By how many interfaces a server's limit over all robots is exceeded; only those that are."""
    bound: float = -math.inf
    """No plan that exceeds capacities by no more costs less."""
    unproven: int = 0
    """Groups of blocks whose gap stayed wider than wanted in the time given."""

    @property
    def cost(self) -> float:
        """Of all blocks, as the objective has it."""
        return sum(block.cost for block in self.blocks.values())

    @property
    def gap(self) -> float:
        """By which share of the bound the cost is above it, at most 1."""
        return relative_gap(self.cost, self.bound) if self.blocks else 0.0

    @property
    def relaxed(self) -> int:
        """By how many interfaces capacities are exceeded in all."""
        return sum(block.excess for block in self.blocks.values()) + sum(self.fleet_excess.values())


def relative_gap(cost: float, bound: float) -> float:
    """By which share of the bound a cost is above it, at most 1; rounding aside, it is never below."""
    if math.isinf(bound):
        return 1.0
    return min(1.0, max(0.0, cost - bound) / max(abs(bound), 1e-9))


@dataclass(frozen=True, order=True, slots=True)
class Price:
    """What a plan costs; ordered: first keep to the capacities, then miss few deadlines."""

    excess: int
    cost: float


def price(problem: Problem, choices: Mapping[BlockKey, Choice]) -> Price:
    """What choices cost, of which each must be valid."""
    excess = sum(block_excess(block, choices[block.key]) for block in problem.blocks)
    excess += sum(fleet_excess(problem, choices).values())
    return Price(excess, sum(block_cost(problem.objective, block, choices[block.key]) for block in problem.blocks))


def make_plan(
    problem: Problem,
    choices: Mapping[BlockKey, Choice],
    *,
    bound: float = -math.inf,
    unproven: int = 0,
    before: Mapping[BlockKey, BlockPlan] | None = None,
) -> Plan:
    """Write choices down as a plan; those that are as `before`, for the same blocks, are the same objects."""
    plans: dict[BlockKey, BlockPlan] = {}
    for block in problem.blocks:
        choice = choices[block.key]
        known = before.get(block.key) if before is not None else None
        if known is not None and known.block is block and known.choice == choice:
            plans[block.key] = known
            continue
        pairs = [(i, j) for i, j in enumerate(choice) if j is not None]
        plans[block.key] = BlockPlan(
            key=block.key,
            assignments=tuple((block.interfaces[i], block.servers[j]) for i, j in pairs),
            cost=block_cost(problem.objective, block, choice),
            predicted_miss=joint_miss(block, choice),
            excess=block_excess(block, choice),
            block=block,
            choice=choice,
        )
    return Plan(plans, fleet_excess(problem, choices), bound, unproven)


def choice_of(block: Block, plan: BlockPlan | None) -> Choice | None:
    """The plan's choice in the block's present numbering; None if it is not valid there any more."""
    if plan is None:
        return None
    if plan.block is block:
        return plan.choice
    server_of = dict(plan.assignments)
    index = {server: number for number, server in enumerate(block.servers)}
    choice: list[int | None] = []
    for interface in block.interfaces:
        server = server_of.get(interface)
        if server is not None and server not in index:
            return None
        choice.append(index[server] if server is not None else None)
    found = tuple(choice)
    return found if is_valid(block, found) else None
