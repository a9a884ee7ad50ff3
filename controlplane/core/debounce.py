"""When to solve again, and when the answer is worth a change."""

from __future__ import annotations

import enum
import math
from typing import TYPE_CHECKING

from controlplane.core.grouping import independent_groups
from controlplane.core.objectives import joint_miss
from controlplane.core.plan import Plan, choice_of, make_plan, price
from controlplane.core.problem import Objective

if TYPE_CHECKING:
    from collections.abc import Mapping

    from controlplane.core.plan import BlockPlan
    from controlplane.core.problem import BlockKey, Choice, FleetKey, Problem

URGENT_DELAY_S = 0.05
"""From a path's or a sidecar's coming or going to the next solving: time for what comes along with it (both
interfaces of a robot that enters a tunnel), and little beside the second a human would notice."""

ROUTINE_INTERVAL_S = 1.0
"""Between two solvings for the sake of new reports alone: epsilons move with a half-life of about a minute."""

ROUTINE_TIMES = 4.0
"""Routine solvings of a large fleet start this many times their own duration apart, to leave time for the rest."""

IMPROVEMENT_SHARE = 0.1
IMPROVEMENT_MIN = 0.002
"""What a new plan must save of a group's sum of miss probabilities, as a share and in all: below, it is the noise of
the reports, and a change itself costs the requests in flight a detour."""

IMPROVEMENT_LOG = -math.log(1 - IMPROVEMENT_SHARE)
"""The same share where logarithms are summed, for each block that changes."""

IMPROVEMENT_MIN_ALL_MISS = 1e-4
"""What it must save of the expected number of requests that miss, one of each block: products are smaller."""


class Change(enum.Enum):
    """What changed the picture."""

    REPORT = "report"
    """New measurements."""
    PATH = "path"
    """A path went up or down."""
    MEMBERS = "members"
    """A sidecar, its addresses or its services came, went or changed."""


class Debounce:
    """Says when to solve. Times are monotonic seconds."""

    def __init__(self) -> None:
        self._due: float | None = None
        self._started = float("-inf")
        self._next_routine = float("-inf")
        self._running = False

    def note(self, change: Change, now: float) -> None:
        """The picture changed."""
        if change is Change.REPORT:
            at = max(now, self._next_routine)
        else:
            at = now + URGENT_DELAY_S
        self._due = at if self._due is None else min(self._due, at)

    def next_time(self) -> float | None:
        """When to solve; None while nothing changed, or while a solving runs."""
        return None if self._running else self._due

    def start(self, now: float) -> bool:
        """Whether to solve now; if so, `finished` has to follow."""
        due = self.next_time()
        if due is None or due > now:
            return False
        self._due = None
        self._started = now
        self._next_routine = now + ROUTINE_INTERVAL_S
        self._running = True
        return True

    def finished(self, now: float) -> None:
        """The solving that `start` began has ended."""
        self._running = False
        interval = max(ROUTINE_INTERVAL_S, ROUTINE_TIMES * (now - self._started))
        self._next_routine = self._started + interval


def settle(problem: Problem, new: Plan, running: Plan | None) -> Plan:
    """Take of the new plan what is worth it, and keep the rest of the running one.

    Group by group (blocks that share a limit change together): the new choice is taken if the running one is not
    valid any more (a path or a server of it is gone, an interface came), exceeds the capacities by more, or costs,
    at today's epsilons, too much more: see `IMPROVEMENT_SHARE` and what follows it.
    """
    blocks: dict[BlockKey, BlockPlan] = {}
    excess: dict[FleetKey, int] = {}
    for group in independent_groups(problem):
        newer = _choices(group, new)
        older = _choices(group, running) if running is not None else None
        if newer is None:
            # The new plan answers this very problem, so it has a choice for every block.
            raise ValueError("the plan does not fit the problem")
        taken = older if older is not None and not _is_worth_it(group, newer, older) else newer
        part = make_plan(group, taken)
        blocks.update(part.blocks)
        excess.update(part.fleet_excess)
    return Plan(blocks, excess, new.bound, new.unproven)


def _choices(group: Problem, plan: Plan) -> dict[BlockKey, Choice] | None:
    choices: dict[BlockKey, Choice] = {}
    for block in group.blocks:
        choice = choice_of(block, plan.blocks.get(block.key))
        if choice is None:
            return None
        choices[block.key] = choice
    return choices


def _is_worth_it(group: Problem, new: Mapping[BlockKey, Choice], old: Mapping[BlockKey, Choice]) -> bool:
    now, then = price(group, new), price(group, old)
    if now.excess != then.excess:
        return now.excess < then.excess
    saved = then.cost - now.cost
    if group.objective is Objective.SUM:
        return saved > max(IMPROVEMENT_MIN, IMPROVEMENT_SHARE * then.cost)
    changed = [block for block in group.blocks if new[block.key] != old[block.key]]
    fewer = sum(joint_miss(block, old[block.key]) - joint_miss(block, new[block.key]) for block in changed)
    return saved > IMPROVEMENT_LOG * len(changed) and fewer > IMPROVEMENT_MIN_ALL_MISS
