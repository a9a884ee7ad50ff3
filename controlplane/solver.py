"""The assignment problem in CP-SAT; the only file that imports OR-Tools.

A pure function: one worker and a fixed seed, so that the same problem gives the same plan with the same version of
OR-Tools. It releases the interpreter while it searches, hence a thread suffices to run it.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from ortools.sat.python import cp_model

from controlplane.core.greedy import greedy
from controlplane.core.grouping import independent_groups
from controlplane.core.plan import choice_of, make_plan
from controlplane.core.problem import FleetKey

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Any

    from controlplane.core.plan import Plan
    from controlplane.core.problem import Block, BlockKey, Choice, Problem

RESOLUTION = 1e-7
"""CP-SAT counts in integers: two epsilons closer than this are the same to it. No posterior mean over less than a
million requests is finer."""

_SCALE = round(1 / RESOLUTION)

MIN_GROUP_TIME_S = 0.01
"""Time a group of blocks gets even when those before it used up the limit: a small one is solved in less."""


def solve(problem: Problem, *, time_limit_s: float, hint: Plan | None = None) -> Plan:
    """Find the plan with the least excess over the capacities and, among those, the least sum of epsilon_ij.

    Groups of blocks that share no limit are solved one after the other within `time_limit_s` seconds together. A
    group out of time keeps the best plan found, the hint's or a greedy one, and counts as unproven.
    """
    end = time.monotonic() + time_limit_s
    choices: dict[BlockKey, Choice] = {}
    unproven = 0
    for group in independent_groups(problem):
        left = max(MIN_GROUP_TIME_S, end - time.monotonic())
        found, proven = _solve_group(group, left, hint)
        choices.update(found)
        unproven += not proven
    return make_plan(problem, choices, unproven=unproven)


def _solve_group(group: Problem, time_limit_s: float, hint: Plan | None) -> tuple[dict[BlockKey, Choice], bool]:
    start = _starting_point(group, hint)
    if all(_has_one_choice(block) for block in group.blocks):
        return start, True
    model = _Model(group, start)
    solver = cp_model.CpSolver()
    solver.parameters.num_workers = 1
    solver.parameters.random_seed = 0
    solver.parameters.max_time_in_seconds = time_limit_s
    status = solver.solve(model.model)
    if status in (cp_model.OPTIMAL, cp_model.FEASIBLE):
        return model.choices(solver), status == cp_model.OPTIMAL
    return start, False


def _has_one_choice(block: Block) -> bool:
    if block.idempotent:
        return all(sum(epsilon is not None for epsilon in row) == 1 for row in block.epsilon)
    return len(block.servers) == 1


def _starting_point(group: Problem, hint: Plan | None) -> dict[BlockKey, Choice]:
    start = greedy(group)
    if hint is not None:
        for block in group.blocks:
            choice = choice_of(block, hint.blocks.get(block.key))
            if choice is not None:
                start[block.key] = choice
    return start


class _Model:
    """One group of blocks as a CP-SAT model."""

    def __init__(self, group: Problem, start: Mapping[BlockKey, Choice]) -> None:
        self.model: Any = cp_model.CpModel()
        self._group = group
        self._chosen: dict[tuple[BlockKey, int, int], Any] = {}
        self._cost: list[Any] = []
        self._excess: list[Any] = []
        fleet: dict[FleetKey, list[Any]] = {}
        for block in group.blocks:
            by_server = self._add_block(block, start[block.key])
            for server, variables in zip(block.servers, by_server, strict=True):
                fleet.setdefault(FleetKey(server, block.key.service), []).extend(variables)
        for key, limit in group.fleet_capacity.items():
            self._limit(fleet.get(key, []), limit)
        # One interface too many weighs more than all deadlines missed: capacities come first.
        interfaces = sum(len(block.interfaces) for block in group.blocks)
        self.model.minimize(sum(self._cost) + (interfaces * _SCALE + 1) * sum(self._excess))

    def _add_block(self, block: Block, start: Choice) -> list[list[Any]]:
        """Variables and rules of one block; returns the variables by server."""
        by_server: list[list[Any]] = [[] for _ in block.servers]
        single = None
        if not block.idempotent:
            single = [self.model.new_bool_var("") for _ in block.servers]
            self.model.add_exactly_one(single)
        for i, row in enumerate(block.epsilon):
            of_interface: list[Any] = []
            for j, epsilon in enumerate(row):
                if epsilon is None:
                    if single is not None:
                        # The one server cannot be reached over this interface: a sure miss.
                        self._cost.append(_SCALE * single[j])
                    continue
                x = self.model.new_bool_var("") if single is None else single[j]
                self._chosen[block.key, i, j] = x
                self._cost.append(round(epsilon * _SCALE) * x)
                of_interface.append(x)
                by_server[j].append(x)
                if single is None:
                    self.model.add_hint(x, start[i] == j)
            if single is None:
                self.model.add_exactly_one(of_interface)
        if single is not None:
            for j, y in enumerate(single):
                self.model.add_hint(y, j in start)
                if not by_server[j]:
                    # A server that no interface reaches is no answer.
                    self.model.add(y == 0)
        elif block.capacity:
            for variables in by_server:
                self._limit(variables, block.capacity)
        return by_server

    def _limit(self, variables: list[Any], limit: int) -> None:
        """At most `limit` of the variables, or as few more as possible."""
        if len(variables) <= limit:
            return
        excess = self.model.new_int_var(0, len(variables) - limit, "")
        self.model.add(sum(variables) <= limit + excess)
        self._excess.append(excess)

    def choices(self, solver: Any) -> dict[BlockKey, Choice]:
        """The choices of the solution found."""
        found: dict[BlockKey, Choice] = {}
        for block in self._group.blocks:
            choice: list[int | None] = []
            for i in range(len(block.interfaces)):
                chosen = (
                    j
                    for j in range(len(block.servers))
                    if (block.key, i, j) in self._chosen and solver.boolean_value(self._chosen[block.key, i, j])
                )
                choice.append(next(chosen, None))
            found[block.key] = tuple(choice)
        return found
