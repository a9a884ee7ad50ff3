"""Plans for blocks that share servers: decomposition first, then CP-SAT.

CP-SAT searches the gap that the decomposition leaves between plan and bound. In a small group it searches until the
optimum is proven, in a large one only if the gap is wide.
"""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from plr.controlplane.core.problem.plan import choice_of, relative_gap
from plr.controlplane.core.solve.decomposition import Decomposition, Relaxed
from plr.controlplane.core.solve.limits import Limits
from plr.controlplane.solver.cp_sat import RESOLUTION, Column, pick_columns

if TYPE_CHECKING:
    from collections.abc import Mapping

    from plr.controlplane.core.problem.plan import Plan
    from plr.controlplane.core.problem.problem import Block, BlockKey, Choice, FleetKey, Problem

log = logging.getLogger(__name__)

TELL_AGAIN_S = 60.0
MAX_LOGGED_FAILURES = 1024
"""Failed blocks remembered with the time of their log line; beyond that all are forgotten and may be logged again."""

SMALL_BLOCKS = 64
"""Groups of up to this many blocks are solved to the optimum if time allows."""

GOOD_GAP = 0.002
"""The decomposition of a larger group ends when the plan costs at most this share more than the bound: less than any
estimate resolves."""

WANTED_GAP = 0.01
"""CP-SAT searches a larger group only beyond this gap: the search takes all the time there is, saves little, and keeps
robots waiting whose network changes meanwhile."""

MIN_GROUP_TIME_S = 0.01
"""Time a group gets for the search even if the groups before it used up the limit."""

MAX_COLUMNS = 30_000
"""Most choices, over all blocks of a group, that CP-SAT is given."""

COLUMNS_A_SECOND = 30_000
"""Choices set up in a second; CP-SAT is given no more than there is time for."""

MIN_COLUMNS_BLOCK = 4
MAX_COLUMNS_BLOCK = 4096


@dataclass(frozen=True, slots=True)
class Found:
    """The choices of one group's blocks."""

    choices: Mapping[BlockKey, Choice]
    bound: float
    """Lower bound on the cost of any plan that does not exceed capacities by more."""
    proven: bool
    """Whether cost and bound are as close as wanted, and no plan exceeds capacities by less."""
    prices: Mapping[FleetKey, float]
    """Prices of the limits, to start from next time."""
    worth: Mapping[BlockKey, float]
    """Value of each block's best choice at these prices; their sum less the prices of the capacities is a bound too."""


class FailureLog:
    """Logs which blocks could not be solved, each once a minute."""

    def __init__(self) -> None:
        self._told: dict[BlockKey, float] = {}

    def note(self, key: BlockKey, error: Exception, now: float) -> None:
        """Log that solving this block raised."""
        if now - self._told.get(key, -math.inf) < TELL_AGAIN_S:
            return
        if len(self._told) >= MAX_LOGGED_FAILURES:
            self._told.clear()
        self._told[key] = now
        log.error("%s of %s could not be solved and keeps its mapping: %r", key.service, key.robot, error)


_failures = FailureLog()


def solve_group(group: Problem, end: float, hint: Plan | None, prices: Mapping[FleetKey, float]) -> Found:
    """Solve a group.

    If that fails because of an unforeseen block, each other block gets its best choice, without regard to shared
    limits, and the failed one keeps what it has.
    """
    try:
        return GroupSolver(group, end).solve(hint, prices)
    except Exception as error:
        if len(group.blocks) == 1:
            _failures.note(group.blocks[0].key, error, time.monotonic())
    choices: dict[BlockKey, Choice] = {}
    for block in group.blocks:
        alone = replace(group, blocks=(block,), fleet_capacity={})
        try:
            choices |= GroupSolver(alone, end).solve(hint, {}).choices
        except Exception as error:
            _failures.note(block.key, error, time.monotonic())
            choices[block.key] = _at_hand(block, hint)
    return Found(choices, -math.inf, proven=False, prices={}, worth={})


def _at_hand(block: Block, hint: Plan | None) -> Choice:
    """Return the block's present choice if that is still possible, else its best path alone."""
    kept = choice_of(block, hint.blocks.get(block.key)) if hint is not None else None
    if kept is not None:
        return kept
    paths = [(e, i, j) for i, row in enumerate(block.epsilon) for j, e in enumerate(row) if e is not None]
    _, interface, server = min(paths, default=(1.0, -1, -1))
    return tuple(server if i == interface else None for i in range(len(block.interfaces)))


class GroupSolver:
    """Solves one group until `end`, on `time.monotonic`."""

    def __init__(self, group: Problem, end: float) -> None:
        self._group = group
        self._end = end
        self._is_small = len(group.blocks) <= SMALL_BLOCKS
        self._wanted_gap = 0.0 if self._is_small else WANTED_GAP
        self._limits = Limits(group)

    def solve(self, hint: Plan | None, prices: Mapping[FleetKey, float]) -> Found:
        """Solve the group, starting from the previous prices and plan."""
        decomposition = Decomposition(self._group, self._limits, prices)
        relaxed = decomposition.run(
            self._hinted(hint),
            good_gap=0.0 if self._is_small else GOOD_GAP,
            out_of_time=lambda: time.monotonic() > self._end,
        )
        proven = self._is_good(relaxed.standing.cost, relaxed) and relaxed.excess_proven
        choices, bound = relaxed.standing.choices(), relaxed.bound
        if not proven and len(self._limits) and (self._is_small or time.monotonic() < self._end):
            choices, bound, proven = self._search(relaxed)
        found = dict(zip(self._limits.keys, relaxed.price.tolist(), strict=False))
        return Found(choices, bound, proven, found, decomposition.worth(relaxed.price))

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

    def _is_good(self, cost: float, relaxed: Relaxed) -> bool:
        if cost - relaxed.bound <= RESOLUTION * len(self._group.blocks):
            return True
        return relative_gap(cost, relaxed.bound, relaxed.standing.size) <= self._wanted_gap

    def _search(self, relaxed: Relaxed) -> tuple[dict[BlockKey, Choice], float, bool]:
        """Let CP-SAT choose among the choices that the bound does not rule out."""
        standing, limits = relaxed.standing, self._limits
        margin = math.inf if relaxed.extra else standing.cost - relaxed.bound
        left_s = max(MIN_GROUP_TIME_S, self._end - time.monotonic())
        columns_all = min(MAX_COLUMNS, int(COLUMNS_A_SECOND * left_s))
        at_most = min(MAX_COLUMNS_BLOCK, max(MIN_COLUMNS_BLOCK, columns_all // len(self._group.blocks)))
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
            return choices, cost, True
        return choices, relaxed.bound, relaxed.excess_proven and self._is_good(cost, relaxed)
