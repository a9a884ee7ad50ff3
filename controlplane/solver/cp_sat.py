"""Solves with CP-SAT what the decomposition of an assignment problem leaves open; only this file imports OR-Tools.

OR-Tools is imported when it is first needed, or once there is time for it (`prepare`). The import takes more than a
second of processor time, and after a restart, when a whole fleet comes back, most problems do not need it.

Columns are whole choices of a block, so that every objective is linear. With one worker and a fixed seed, the same
columns give the same answer in the same version of OR-Tools. CP-SAT releases the interpreter while it searches, so a
thread suffices to run it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

RESOLUTION = 1e-7
"""CP-SAT counts in integers: it cannot tell two costs apart that are closer than this. No posterior mean over less than
a million requests is finer."""

_LARGEST = 2.0**61
"""Largest objective for CP-SAT: half of its integer range. Costs that range further are counted in larger steps."""


@dataclass(frozen=True, slots=True)
class Column:
    """One choice of a block."""

    cost: float
    excess: int
    """Number of interfaces beyond the block's own capacity."""
    limits: tuple[int, ...]
    """For each interface under a limit over all robots, the index of that limit."""


def prepare() -> None:
    """Import OR-Tools, so that the first problem that needs it does not wait for the import."""
    import ortools.sat.python.cp_model  # noqa: F401


def pick_columns(
    blocks: Sequence[Sequence[Column]], capacity: Sequence[int], hint: Sequence[int], *, time_limit_s: float
) -> tuple[list[int], bool]:
    """Choose a column for each block so that the plan exceeds capacities least and, among such plans, costs least.

    Returns these columns, or the hint if nothing better is found in time, and whether the answer is proven optimal.
    """
    from ortools.sat.python import cp_model

    model: Any = cp_model.CpModel()
    chosen: list[list[Any]] = []
    objective: list[Any] = []
    excess: list[Any] = []
    users: list[list[tuple[int, Any]]] = [[] for _ in capacity]
    costs_most = 0
    scale = _scale(blocks)
    for columns, hinted in zip(blocks, hint, strict=True):
        least = min(column.cost for column in columns)
        costs = [round((column.cost - least) * scale) for column in columns]
        costs_most += max(costs)
        variables = [model.new_bool_var("") for _ in columns]
        model.add_exactly_one(variables)
        for number, (variable, cost, column) in enumerate(zip(variables, costs, columns, strict=True)):
            model.add_hint(variable, number == hinted)
            objective.append(cost * variable)
            if column.excess:
                excess.append(column.excess * variable)
            for limit in set(column.limits):
                users[limit].append((column.limits.count(limit), variable))
        chosen.append(variables)
    for limit, terms in zip(capacity, users, strict=True):
        over = model.new_int_var(0, sum(count for count, _ in terms), "")
        model.add(sum(count * variable for count, variable in terms) <= limit + over)
        excess.append(over)
    # One interface too many weighs more than everything else: capacities come first.
    model.minimize(sum(objective) + (costs_most + 1) * sum(excess))
    solver = cp_model.CpSolver()
    solver.parameters.num_workers = 1
    solver.parameters.random_seed = 0
    solver.parameters.max_time_in_seconds = time_limit_s
    status = solver.solve(model)
    if status not in (cp_model.OPTIMAL, cp_model.FEASIBLE):
        return list(hint), False
    found = [
        next(number for number, variable in enumerate(variables) if solver.boolean_value(variable))
        for variables in chosen
    ]
    return found, status == cp_model.OPTIMAL


def _scale(blocks: Sequence[Sequence[Column]]) -> float:
    costs = [[column.cost for column in columns] for columns in blocks]
    costs_most = sum(max(of_block) - min(of_block) for of_block in costs)
    excess_most = sum(max(column.excess + len(column.limits) for column in columns) for columns in blocks)
    return min(1 / RESOLUTION, _LARGEST / (1 + costs_most) / (2 + excess_most))
