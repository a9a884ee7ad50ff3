"""Solves one assignment problem after another, each within a time limit, and carries over what it learned.

Blocks that share no limit over all robots get their best choice at once, the others by groups (`group`). When few
blocks of a large fleet have changed since the last problem, only these choose again, within the capacity that the
others leave. The prices of the last whole solution tell how far from the optimum that is.
"""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from plr.controlplane.core.problem.plan import Plan, make_plan
from plr.controlplane.core.problem.problem import FleetKey, reachable
from plr.controlplane.core.solve.decomposition import Decomposition
from plr.controlplane.core.solve.limits import Limits, independent_groups
from plr.controlplane.solver.group import SMALL_BLOCKS, solve_group

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from plr.controlplane.core.problem.problem import Block, BlockKey, Problem

CHANGED_SHARE = 0.02
"""Beyond this share of changed blocks all are solved: that costs little more, and can move others out of the way."""

INCREMENTAL_GAP = 0.01
"""All blocks are solved again once the plan may cost this share more than the optimum, on top of the gap that the last
whole solution left: within that gap, solving all might do no better."""


def solve(problem: Problem, *, time_limit_s: float, hint: Plan | None = None) -> Plan:
    """Return the plan for one problem, by a matcher without history."""
    return Matcher().solve(problem, time_limit_s=time_limit_s, hint=hint)


@dataclass(frozen=True, slots=True)
class _Kept:
    """The last problem with its plan, and what was learned from it."""

    problem: Problem
    blocks: Mapping[BlockKey, Block]
    plan: Plan
    load: Mapping[FleetKey, int]
    prices: Mapping[FleetKey, float]
    worth: Mapping[BlockKey, float]
    gap: float
    """Gap of the last whole solution."""


class Matcher:
    """Solves one problem after the other."""

    def __init__(self) -> None:
        self._kept: _Kept | None = None
        self.incremental = 0
        """Problems of which only the changed blocks were solved."""

    def solve(self, problem: Problem, *, time_limit_s: float, hint: Plan | None = None) -> Plan:
        """Find the plan with the least excess over the capacities and, among those, the least cost.

        Groups that share no limit with each other are solved one after the other, within `time_limit_s` seconds in all.
        A group that runs out of time keeps the best plan found, and counts as unproven.
        """
        end = time.monotonic() + time_limit_s
        kept = self._kept
        if kept is not None:
            plan = self._solve_changed(problem, kept, end)
            if plan is not None:
                self.incremental += 1
                return plan
        return self._solve_all(problem, end, hint, kept.prices if kept is not None else {})

    def _solve_all(self, problem: Problem, end: float, hint: Plan | None, prices: Mapping[FleetKey, float]) -> Plan:
        found = [solve_group(group, end, hint, prices) for group in _groups(problem)]
        plan = make_plan(
            problem,
            {key: choice for group in found for key, choice in group.choices.items()},
            bound=sum(group.bound for group in found),
            unproven=sum(not group.proven for group in found),
        )
        self._kept = _Kept(
            problem,
            {block.key: block for block in problem.blocks},
            plan,
            _loads(problem, plan, plan.blocks),
            {key: price for group in found for key, price in group.prices.items()},
            {key: worth for group in found for key, worth in group.worth.items()},
            plan.gap,
        )
        return plan

    def _solve_changed(self, problem: Problem, kept: _Kept, end: float) -> Plan | None:
        """Return the plan that solves the changed blocks alone; None if that is not possible or not good enough."""
        last = kept.problem
        same_frame = (problem.objective, problem.fleet_capacity) == (last.objective, last.fleet_capacity)
        if not same_frame or kept.plan.fleet_excess or len(problem.blocks) <= SMALL_BLOCKS:
            return None
        blocks = {block.key: block for block in problem.blocks}
        changed = [
            block for key, block in blocks.items() if (old := kept.blocks.get(key)) is not block and old != block
        ]
        if len(changed) > max(1, CHANGED_SHARE * len(blocks)):
            return None
        left_out = {block.key for block in changed} | (kept.blocks.keys() - blocks.keys())
        load = dict(kept.load)
        for key, count in _loads(kept.problem, kept.plan, left_out & kept.plan.blocks.keys()).items():
            load[key] -= count
        free = {key: limit - load.get(key, 0) for key, limit in problem.fleet_capacity.items()}
        part = _part(problem, changed, free)
        if part is None:
            return None
        found = [solve_group(group, end, None, {}) for group in _groups(part)]
        choices = {key: choice for group in found for key, choice in group.choices.items()}
        added = make_plan(replace(part, blocks=tuple(changed)), choices)
        if added.fleet_excess:
            return None
        for key, count in _loads(problem, added, added.blocks).items():
            load[key] = load.get(key, 0) + count
        worth = {key: value for key, value in kept.worth.items() if key not in left_out}
        worth.update(_worth(replace(problem, blocks=tuple(changed)), kept.prices))
        paid = sum(price * problem.fleet_capacity[key] for key, price in kept.prices.items())
        plan = Plan(
            {key: added.blocks.get(key) or kept.plan.blocks[key] for key in blocks},
            bound=sum(worth.values()) - paid,
            unproven=kept.plan.unproven,
        )
        if plan.gap > kept.gap + INCREMENTAL_GAP:
            return None
        self._kept = _Kept(problem, blocks, plan, load, kept.prices, worth, kept.gap)
        return plan


def _groups(problem: Problem) -> list[Problem]:
    """Return the groups of blocks that share a limit, and all other blocks together."""
    groups = independent_groups(problem)
    free = tuple(block for group in groups if not group.fleet_capacity for block in group.blocks)
    bound = [group for group in groups if group.fleet_capacity]
    return [replace(problem, blocks=free, fleet_capacity={}), *bound] if free else bound


def _part(problem: Problem, changed: Iterable[Block], free: Mapping[FleetKey, int]) -> Problem | None:
    """Return the changed blocks without the servers that the others fill; None if an interface would have none left."""
    blocks = []
    for block in changed:
        full = {server for server in block.servers if free.get(FleetKey(server, block.key.service), 1) <= 0}
        epsilon = tuple(
            tuple(None if server in full else value for server, value in zip(block.servers, row, strict=True))
            for row in block.epsilon
        )
        if not all(reachable(row) for row in epsilon):
            return None
        blocks.append(replace(block, epsilon=epsilon))
    used = {FleetKey(server, block.key.service) for block in blocks for server in block.servers}
    return replace(
        problem, blocks=tuple(blocks), fleet_capacity={key: limit for key, limit in free.items() if key in used}
    )


def _loads(problem: Problem, plan: Plan, keys: Iterable[BlockKey]) -> Counter[FleetKey]:
    """Count the interfaces that these blocks of a plan assign to each server with a limit."""
    used = (FleetKey(server, key.service) for key in keys for _, server in plan.blocks[key].assignments)
    return Counter(key for key in used if key in problem.fleet_capacity)


def _worth(problem: Problem, prices: Mapping[FleetKey, float]) -> dict[BlockKey, float]:
    """Return the least value of each block at these prices."""
    limits = Limits(problem)
    decomposition = Decomposition(problem, limits, prices)
    return decomposition.worth(decomposition.start)
