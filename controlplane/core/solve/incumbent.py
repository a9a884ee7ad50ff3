"""Holds choices for all blocks of a group, in arrays, and moves single blocks to better ones.

A move is taken if it exceeds the capacities by less in total, or by as much at less cost. So a standing only improves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from plr.controlplane.core.problem.costs import block_cost
from plr.controlplane.core.problem.plan import size
from plr.controlplane.core.problem.problem import block_excess
from plr.controlplane.core.solve.exchange import trade

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from plr.controlplane.core.problem.problem import BlockKey, Choice, Objective
    from plr.controlplane.core.solve.batch import Best, Stack
    from plr.controlplane.core.solve.exchange import Move
    from plr.controlplane.core.solve.limits import Limits

    Floats = NDArray[np.float64]
    Indices = NDArray[np.intp]

MIN_GAIN = 1e-12
"""Costs closer than this are equal: rounding."""

MAX_SWEEPS = 40
"""Passes over all blocks: each removes some excess or saves some cost, or is the last."""


@dataclass(slots=True)
class Part:
    """The choices of one stack."""

    picks: Indices
    cost: Floats
    excess: Indices


class Standing:
    """A choice for every block of the stacks."""

    def __init__(self, stacks: Sequence[Stack], limits: Limits, parts: list[Part]) -> None:
        self.stacks = stacks
        self.limits = limits
        self.parts = parts
        self.load: NDArray[np.int64] = limits.loads(
            [np.take_along_axis(stack.limit, part.picks, 1) for stack, part in zip(stacks, parts, strict=True)]
        )

    @classmethod
    def of_best(cls, stacks: Sequence[Stack], limits: Limits, price: Floats, best: Sequence[Best]) -> Standing:
        """Take the blocks' best choices at these prices of the limits."""
        parts = []
        for stack, found in zip(stacks, best, strict=True):
            paid = price[np.take_along_axis(stack.limit, found.picks, 1)].sum(axis=1)
            parts.append(Part(found.picks.copy(), found.value - paid, found.excess.copy()))
        return cls(stacks, limits, parts)

    @classmethod
    def of_choices(
        cls, objective: Objective, stacks: Sequence[Stack], limits: Limits, choices: Mapping[BlockKey, Choice]
    ) -> Standing:
        """Take these choices, one for every block."""
        parts = []
        for stack in stacks:
            chosen = [choices[block.key] for block in stack.blocks]
            both = list(zip(stack.blocks, chosen, strict=True))
            parts.append(
                Part(
                    np.array([stack.picks_of(choice) for choice in chosen], dtype=np.intp),
                    np.array([block_cost(objective, block, choice) for block, choice in both]),
                    np.array([block_excess(block, choice) for block, choice in both], dtype=np.intp),
                )
            )
        return cls(stacks, limits, parts)

    @property
    def cost(self) -> float:
        """Cost of all blocks."""
        return float(sum(part.cost.sum() for part in self.parts))

    @property
    def size(self) -> float:
        """Size of the cost of all blocks, as defined by `plan.size`."""
        return sum(size(part.cost) for part in self.parts)

    @property
    def excess(self) -> int:
        """Number of interfaces by which capacities are exceeded: the blocks' own, and those over all robots."""
        own = sum(int(part.excess.sum()) for part in self.parts)
        return own + int(np.maximum(0, self.load - self.limits.capacity).sum())

    def is_better_than(self, other: Standing) -> bool:
        """Return whether it exceeds less, or as much at less cost."""
        return (self.excess, self.cost) < (other.excess, other.cost)

    def choices(self) -> dict[BlockKey, Choice]:
        """Return the choices by block."""
        return {
            block.key: stack.choice_of(picks)
            for stack, part in zip(self.stacks, self.parts, strict=True)
            for block, picks in zip(stack.blocks, part.picks, strict=True)
        }

    def settle(self, price: Floats, out_of_time: Callable[[], bool]) -> None:
        """Move blocks away from exceeded limits, first those that lose least at these prices, even when out of time.
        Then move blocks to what is cheaper for them, within the limits; then two at a time."""
        for _ in range(MAX_SWEEPS):
            if not self._sweep(price, crowded_only=True):
                break
        nothing = np.zeros_like(price)
        for _ in range(MAX_SWEEPS):
            if out_of_time() or not self._sweep(nothing, crowded_only=False):
                break
        trade(self, out_of_time)

    def exchange(self, goer: Move, comer: Move) -> bool:
        """Make both moves if together they cost less and exceed no more; return False if not."""
        if (goer.stack, goer.row) == (comer.stack, comer.row):
            return False
        part = self.parts[goer.stack]
        before = part.picks[goer.row].copy(), float(part.cost[goer.row]), int(part.excess[goer.row])
        if not self._move(goer.stack, goer.row, goer.picks, goer.cost, goer.excess, may_lose=-comer.more):
            return False
        if self._move(comer.stack, comer.row, comer.picks, comer.cost, comer.excess):
            return True
        self._move(goer.stack, goer.row, *before, may_lose=math.inf)
        return False

    def _sweep(self, price: Floats, *, crowded_only: bool) -> bool:
        crowded = np.append(self.load > self.limits.capacity, False)
        if crowded_only and not crowded.any():
            return False
        moves: list[tuple[float, int, int, Indices, float, int]] = []
        for number, (stack, part) in enumerate(zip(self.stacks, self.parts, strict=True)):
            used: Indices = np.take_along_axis(stack.limit, part.picks, 1)
            is_crowded: NDArray[np.bool_] = np.any(crowded[used], axis=1)
            rows = np.flatnonzero(is_crowded) if crowded_only else stack.every
            if not rows.size:
                continue
            # A block that sits where there is no room may move to where there is none either: no excess is added.
            shut = self._shut(stack, part, rows) & (~is_crowded[rows, None] | crowded_only)
            found = stack.best(rows, np.where(shut, np.inf, price[stack.limit[rows]]))
            now = part.cost[rows] + price[used[rows]].sum(axis=1)
            loss = found.value - now
            useful = np.isfinite(loss) if crowded_only else (loss < -MIN_GAIN) | (found.excess < part.excess[rows])
            costs = found.value - np.where(
                np.isfinite(found.value), price[np.take_along_axis(stack.limit[rows], found.picks, 1)].sum(axis=1), 0.0
            )
            moves.extend(
                (loss[k], number, int(rows[k]), found.picks[k], costs[k], int(found.excess[k]))
                for k in np.flatnonzero(useful)
            )
        moves.sort(key=lambda move: move[:3])
        return sum(self._move(*move[1:]) for move in moves) > 0

    def _shut(self, stack: Stack, part: Part, rows: Indices) -> NDArray[np.bool_]:
        """Return the servers without room for one more interface of each block, not counting its own."""
        room = np.append(self.limits.capacity - self.load, np.iinfo(np.int32).max)
        own = (part.picks[rows][:, :, None] == np.arange(stack.servers + 1)).sum(axis=1)
        shut: NDArray[np.bool_] = room[stack.limit[rows]] + own <= 0
        shut[:, stack.servers] = False
        return shut

    def _move(self, number: int, row: int, picks: Indices, cost: float, excess: int, *, may_lose: float = 0.0) -> bool:
        stack, part = self.stacks[number], self.parts[number]
        change: dict[int, int] = {}
        for limit in stack.limit[row, part.picks[row]].tolist():
            change[limit] = change.get(limit, 0) - 1
        for limit in stack.limit[row, picks].tolist():
            change[limit] = change.get(limit, 0) + 1
        change.pop(len(self.limits), None)
        more = excess - int(part.excess[row])
        for limit, count in change.items():
            over = int(self.load[limit] - self.limits.capacity[limit])
            more += max(0, over + count) - max(0, over)
        if more > 0 or (more == 0 and cost >= part.cost[row] + may_lose - MIN_GAIN):
            return False
        for limit, count in change.items():
            self.load[limit] += count
        part.picks[row], part.cost[row], part.excess[row] = picks, cost, excess
        return True
