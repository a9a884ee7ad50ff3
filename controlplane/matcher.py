"""From an assignment problem to a plan, within a time limit.

Blocks that share no limit over all robots get their best choice at once. Those that do go through the decomposition
(`controlplane.core.decomposition`); what it leaves open between plan and bound is searched by CP-SAT, in a small group
until the optimum is proven, in a large one only if the gap is wide.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from controlplane.core.decomposition import Decomposition, Relaxed
from controlplane.core.grouping import independent_groups
from controlplane.core.limits import Limits
from controlplane.core.plan import choice_of, make_plan, relative_gap
from controlplane.solver import RESOLUTION, Column, pick_columns

if TYPE_CHECKING:
    from collections.abc import Mapping

    from controlplane.core.plan import Plan
    from controlplane.core.problem import BlockKey, Choice, Problem

SMALL_BLOCKS = 64
"""Groups of up to this many blocks are solved to the optimum, if the time allows."""

GOOD_GAP = 0.002
"""Larger groups are left alone once the plan costs at most this share more than the bound: below the resolution of
any estimate."""

MIN_GROUP_TIME_S = 0.01
"""Time a group of blocks gets for the search even when those before it used up the limit."""

MAX_COLUMNS = 30_000
"""Choices of all blocks of a group that CP-SAT is given: a second's work to set up."""

MIN_COLUMNS_BLOCK = 4
MAX_COLUMNS_BLOCK = 4096


def solve(problem: Problem, *, time_limit_s: float, hint: Plan | None = None) -> Plan:
    """Find the plan with the least excess over the capacities and, among those, the least cost.

    Groups of blocks that share no limit are solved one after the other within `time_limit_s` seconds together. A
    group out of time keeps the best plan found, and counts as unproven.
    """
    end = time.monotonic() + time_limit_s
    choices: dict[BlockKey, Choice] = {}
    bound = 0.0
    unproven = 0
    for group in _groups(problem):
        found = _Group(group, end).solve(hint)
        choices.update(found.choices)
        bound += found.bound
        unproven += not found.proven
    return make_plan(problem, choices, bound=bound, unproven=unproven)


def _groups(problem: Problem) -> list[Problem]:
    """The groups that share a limit, and all other blocks together."""
    groups = independent_groups(problem)
    free = tuple(block for group in groups if not group.fleet_capacity for block in group.blocks)
    bound = [group for group in groups if group.fleet_capacity]
    return [replace(problem, blocks=free, fleet_capacity={}), *bound] if free else bound


@dataclass(frozen=True, slots=True)
class _Found:
    choices: Mapping[BlockKey, Choice]
    bound: float
    proven: bool


class _Group:
    def __init__(self, group: Problem, end: float) -> None:
        self._group = group
        self._end = end
        self._is_small = len(group.blocks) <= SMALL_BLOCKS
        self._good_gap = 0.0 if self._is_small else GOOD_GAP
        self._limits = Limits(group)

    def solve(self, hint: Plan | None) -> _Found:
        decomposition = Decomposition(self._group, self._limits, {})
        relaxed = decomposition.run(
            self._hinted(hint), good_gap=self._good_gap, out_of_time=lambda: time.monotonic() > self._end
        )
        proven = self._is_good(relaxed.standing.cost, relaxed.bound) and relaxed.excess_proven
        if proven or not len(self._limits):
            return _Found(relaxed.standing.choices(), relaxed.bound, proven=proven)
        return self._search(relaxed)

    def _hinted(self, hint: Plan | None) -> dict[BlockKey, Choice] | None:
        if hint is None:
            return None
        found: dict[BlockKey, Choice] = {}
        for block in self._group.blocks:
            choice = choice_of(block, hint.blocks.get(block.key))
            if choice is None:
                return None
            found[block.key] = choice
        return found

    def _is_good(self, cost: float, bound: float) -> bool:
        return cost - bound <= RESOLUTION * len(self._group.blocks) or relative_gap(cost, bound) <= self._good_gap

    def _search(self, relaxed: Relaxed) -> _Found:
        """Let CP-SAT choose among the choices that the bound leaves a chance."""
        standing, limits = relaxed.standing, self._limits
        margin = math.inf if relaxed.extra else standing.cost - relaxed.bound
        at_most = min(MAX_COLUMNS_BLOCK, max(MIN_COLUMNS_BLOCK, MAX_COLUMNS // len(self._group.blocks)))
        columns: list[list[Column]] = []
        picks = []
        hint = []
        complete = True
        for stack, part in zip(standing.stacks, standing.parts, strict=True):
            for row in stack.every:
                price = relaxed.price[stack.limit[row]]
                near = stack.near(int(row), price, margin, at_most)
                complete = complete and near.complete
                options = [
                    Column(
                        float(value - price[servers].sum()),
                        int(excess),
                        tuple(limit for limit in stack.limit[row, servers].tolist() if limit < len(limits)),
                    )
                    for value, excess, servers in zip(near.values, near.excess, near.picks, strict=True)
                ]
                servers = [tuple(option.tolist()) for option in near.picks]
                now = tuple(part.picks[row].tolist())
                if now not in servers:
                    servers.append(now)
                    used = stack.limit[row, part.picks[row]].tolist()
                    under = tuple(limit for limit in used if limit < len(limits))
                    options.append(Column(float(part.cost[row]), int(part.excess[row]), under))
                hint.append(servers.index(now))
                columns.append(options)
                picks.append((stack, servers))
        left_s = max(MIN_GROUP_TIME_S, self._end - time.monotonic())
        found, proven = pick_columns(columns, limits.capacity.tolist(), hint, time_limit_s=left_s)
        choices = {}
        cost = 0.0
        keys = [block.key for stack in standing.stacks for block in stack.blocks]
        for key, number, options, (stack, servers) in zip(keys, found, columns, picks, strict=True):
            choices[key] = stack.choice_of(servers[number])
            cost += options[number].cost
        if proven and complete:
            return _Found(choices, cost, proven=True)
        return _Found(choices, relaxed.bound, proven=relaxed.excess_proven and self._is_good(cost, relaxed.bound))
