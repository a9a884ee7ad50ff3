"""Defines what a plan for the assignment problem says, and what it costs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from plr.controlplane.core.problem.costs import block_cost, charge, without_rules
from plr.controlplane.core.problem.domains import shared_domains
from plr.controlplane.core.problem.objectives import joint_miss
from plr.controlplane.core.problem.problem import block_excess, fleet_excess, is_valid
from plr.controlplane.core.problem.shortfall import shortfall

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from plr.controlplane.core.problem.problem import Block, BlockKey, Choice, FleetKey, Problem
    from plr.protos.model.ids import InterfaceName, NodeName
    from plr.protos.model.mapping import Assignment


@dataclass(frozen=True, slots=True)
class BlockPlan:
    """Where one block's requests go."""

    key: BlockKey
    assignments: tuple[tuple[InterfaceName, NodeName], ...]
    cost: float
    """The block's share of what is minimised, see `costs`."""
    predicted_miss: float
    """Probability that all copies miss, see `objectives.joint_miss`."""
    excess: int = 0
    """Number of interfaces by which the block's own capacity is exceeded."""
    shared: tuple[str, ...] = ()
    """Regions and carriers that copies share."""
    target_miss: float = 0.0
    """Target to meet at the least charge; 0: as reliable as possible."""
    charge: float = 0.0
    """What a request costs with all its copies; 0 without a target."""
    shortfall: str = ""
    """By how much the target is missed, and what would meet it."""
    why: str = ""
    """Reason of its last change; empty if it never changed."""
    block: Block | None = field(default=None, compare=False, repr=False)
    choice: Choice = field(default=(), compare=False, repr=False)
    """Block and choice that it was made from."""


@dataclass(frozen=True, slots=True)
class Plan:
    """A plan for a problem."""

    blocks: Mapping[BlockKey, BlockPlan]
    fleet_excess: Mapping[FleetKey, int] = field(default_factory=dict)
    """Number of interfaces by which a server's limit over all robots is exceeded; only exceeded ones are listed."""
    bound: float = -math.inf
    """Lower bound on the cost of plans that exceed capacities by no more."""
    explore: Mapping[BlockKey, Assignment] = field(default_factory=dict)
    """Pairs other than the planned ones of which a few requests would teach most."""
    unproven: int = 0
    """Groups of blocks whose gap stayed wider than wanted in the given time."""

    @property
    def cost(self) -> float:
        """Cost of all blocks under the objective."""
        return sum(block.cost for block in self.blocks.values())

    @property
    def gap(self) -> float:
        """How far the cost is above the bound, see `relative_gap`."""
        costs = [block.cost for block in self.blocks.values()]
        return relative_gap(self.cost, self.bound, size(costs)) if costs else 0.0

    @property
    def relaxed(self) -> int:
        """Total number of interfaces by which capacities are exceeded."""
        return sum(block.excess for block in self.blocks.values()) + sum(self.fleet_excess.values())


def relative_gap(cost: float, bound: float, size: float) -> float:
    """Return how far a cost is above a bound, as a share of `size`, at most 1; it is never below, rounding aside."""
    if math.isinf(bound):
        return 1.0
    return min(1.0, max(0.0, cost - bound) / max(size, 1e-9))


def size(costs: Sequence[float] | NDArray[np.float64]) -> float:
    """Return the sum of the blocks' costs without signs and rules, which would make a gap look smaller or larger."""
    return float(np.abs(without_rules(np.asarray(costs, dtype=np.float64))).sum())


@dataclass(frozen=True, order=True, slots=True)
class PlanCost:
    """Cost of a plan, ordered: first keep to the capacities, then cost little (`costs`)."""

    excess: int
    cost: float


def price(problem: Problem, choices: Mapping[BlockKey, Choice]) -> PlanCost:
    """Return the cost of choices, each of which must be valid."""
    excess = sum(block_excess(block, choices[block.key]) for block in problem.blocks)
    excess += sum(fleet_excess(problem, choices).values())
    return PlanCost(excess, sum(block_cost(problem.objective, block, choices[block.key]) for block in problem.blocks))


def make_plan(
    problem: Problem,
    choices: Mapping[BlockKey, Choice],
    *,
    bound: float = -math.inf,
    unproven: int = 0,
    before: Mapping[BlockKey, BlockPlan] | None = None,
) -> Plan:
    """Write choices down as a plan; for the same block and choice as `before`, reuse the object."""
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
            shared=shared_domains(block, choice),
            target_miss=block.target.miss if block.target is not None else 0.0,
            charge=charge(block.target, choice) if block.target is not None else 0.0,
            shortfall=shortfall(block, choice),
        )
    return Plan(plans, fleet_excess(problem, choices), bound, unproven=unproven)


def choice_of(block: Block, plan: BlockPlan | None) -> Choice | None:
    """Return the plan's choice in the block's present numbering; None if it is no longer valid there."""
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
