"""Finds a good plan for many blocks that share servers, and a lower bound for all plans.

Lagrangian relaxation of the limits over all robots. Each limit gets a price; at given prices the blocks are
independent, and each takes its best choice (`batch`). The sum of these choices' values, less the prices of the
capacities, is below the cost of every plan that keeps to the limits. Prices move along the subgradient, the excess
load, by Polyak's step towards the best plan known. Plans come from the blocks' choices by moving blocks away from where
there is no room (`incumbent`).

If the best plan known exceeds capacities by E more interfaces than the blocks must by themselves, an interface in
excess has a price too, which no price of a limit is above: the bound then holds for plans that exceed by no more.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from plr.controlplane.core.problem.domains import chooses_interfaces, has_shared_regions
from plr.controlplane.core.problem.plan import relative_gap
from plr.controlplane.core.problem.problem import Objective
from plr.controlplane.core.solve.batch import EnumeratedStack, SeparableStack
from plr.controlplane.core.solve.enumeration import MAX_LISTED_CHOICES, OWN_EXCESS_PRICE
from plr.controlplane.core.solve.incumbent import Standing
from plr.controlplane.core.solve.pattern_batch import PatternStack

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from plr.controlplane.core.problem.problem import Block, BlockKey, Choice, FleetKey, Problem
    from plr.controlplane.core.solve.batch import Best, Stack
    from plr.controlplane.core.solve.limits import Limits

    Floats = NDArray[np.float64]

MAX_SUBGRADIENT_STEPS = 300
STEPS_BETWEEN_PLANS = 12
"""Steps between plans: a plan costs as much as some steps."""
PATIENCE_STEPS = 8
"""Steps without a better bound before the step length is halved."""
SHORTEST_STEP = 1e-3

MAX_LISTED_ALL = 4_000_000
"""Choices listed of all blocks together (some 60 bytes each)."""

MIN_LISTED = 256
"""Choices listed of a block in any case: 2 interfaces with 16 servers, 4 with 4."""


MAX_PATTERNS_ALL = 16_000_000
"""Patterns of all blocks together (some 10 bytes each)."""

MAX_PATTERN_INTERFACES = 12
"""With more interfaces there would be a single pattern."""


class Kind(enum.Enum):
    """How a stack finds its blocks' best choices."""

    SEPARABLE = enum.auto()
    ENUMERATED = enum.auto()
    PATTERNS = enum.auto()


def stack_blocks(objective: Objective, blocks: Sequence[Block], limits: Limits) -> list[Stack]:
    """Stack blocks by shape and kind."""
    listed = [block for block in blocks if block.idempotent and not _adds_up(objective, block)]
    at_most = min(MAX_LISTED_CHOICES, max(MIN_LISTED, MAX_LISTED_ALL // max(1, len(listed))))
    shapes: dict[tuple[Kind, bool, int], list[Block]] = {}
    for block in blocks:
        shape = _kind(objective, block, at_most), block.idempotent, len(block.interfaces)
        shapes.setdefault(shape, []).append(block)
    return [_stack(kind, objective, members, limits, at_most) for (kind, _, _), members in shapes.items()]


def _stack(kind: Kind, objective: Objective, blocks: Sequence[Block], limits: Limits, at_most: int) -> Stack:
    match kind:
        case Kind.SEPARABLE:
            return SeparableStack(objective, blocks, limits)
        case Kind.ENUMERATED:
            return EnumeratedStack(objective, blocks, limits, at_most=at_most)
        case Kind.PATTERNS:
            at_most = min(MAX_LISTED_CHOICES, max(MIN_LISTED, MAX_PATTERNS_ALL // len(blocks)))
            return PatternStack(objective, blocks, limits, at_most=at_most)


def _kind(objective: Objective, block: Block, at_most: int) -> Kind:
    if _adds_up(objective, block):
        return Kind.SEPARABLE
    if not block.idempotent or block.target is not None or len(block.interfaces) > MAX_PATTERN_INTERFACES:
        return Kind.ENUMERATED
    options = len(block.servers) + chooses_interfaces(block)
    return Kind.PATTERNS if options ** len(block.interfaces) > at_most else Kind.ENUMERATED


def _adds_up(objective: Objective, block: Block) -> bool:
    """Return whether the block's cost is a sum over its interfaces, which all carry a copy."""
    if not block.idempotent or block.target is not None or chooses_interfaces(block):
        return False
    return not (objective is Objective.JOINT and block.lifts) and not has_shared_regions(block)


@dataclass(frozen=True, slots=True)
class Relaxed:
    """The best plan found, and the bound with the prices that prove it."""

    standing: Standing
    bound: float
    price: Floats
    """Prices by limit; one more at the end, 0."""
    extra: int
    """Number of interfaces by which it exceeds capacities beyond what each block must by itself."""
    excess_proven: bool
    """Whether no plan exceeds capacities by less."""


class Decomposition:
    """Solves one group of blocks."""

    def __init__(self, problem: Problem, limits: Limits, prices: Mapping[FleetKey, float]) -> None:
        self.limits = limits
        self.stacks = stack_blocks(problem.objective, problem.blocks, limits)
        self._objective = problem.objective
        self.start = np.array([*(prices.get(key, 0.0) for key in limits.keys), 0.0])
        free = [stack.free for stack in self.stacks]
        self._forced = [best.excess for best in free]
        self._wanted = sum(block.copies_wanted.least for block in problem.blocks)
        self._forced_all = sum(int(excess.sum()) for excess in self._forced)
        self._best: Standing = Standing.of_best(self.stacks, limits, np.zeros(len(limits) + 1), free)
        self._bound = -np.inf
        self._price = self.start

    def run(
        self, hint: Mapping[BlockKey, Choice] | None, *, good_gap: float, out_of_time: Callable[[], bool]
    ) -> Relaxed:
        """Improve plan and bound until they are within `good_gap`, or out of time."""
        self._best.settle(self.start, out_of_time)
        if hint is not None:
            self._offer(Standing.of_choices(self._objective, self.stacks, self.limits, hint), self.start, out_of_time)
        if len(self.limits):
            self._climb(good_gap, out_of_time)
        else:
            self._bound, _ = self._dual(self.start)
        return Relaxed(self._best, self._bound, self._price, max(0, self._extra()), self._is_excess_proven())

    def worth(self, price: Floats) -> dict[BlockKey, float]:
        """Return a lower bound on each block's best choice at these prices of the limits."""
        found: dict[BlockKey, float] = {}
        for stack in self.stacks:
            prices = price[stack.limit]
            best = stack.best(stack.every, prices)
            values = stack.bound(prices, best, best.excess, OWN_EXCESS_PRICE)
            found.update(zip((block.key for block in stack.blocks), values.tolist(), strict=True))
        return found

    def _climb(self, good_gap: float, out_of_time: Callable[[], bool]) -> None:
        price, length, waited = self.start, 1.0, 0
        for step in range(MAX_SUBGRADIENT_STEPS):
            value, best = self._dual(price)
            if value > self._bound:
                self._bound, self._price, waited = value, price, 0
            else:
                waited += 1
            subgradient = self._subgradient(price, best)
            norm = float(subgradient @ subgradient)
            if step % STEPS_BETWEEN_PLANS == 0 or not norm:
                self._offer(Standing.of_best(self.stacks, self.limits, price, best), price, out_of_time)
            if not norm or length < SHORTEST_STEP or self._is_good(good_gap) or out_of_time():
                break
            if waited >= PATIENCE_STEPS:
                price, length, waited = self._price, length / 2, 0
                continue
            far = max(self._best.cost - value, 1e-9)
            price = np.append(np.maximum(0.0, price[:-1] + length * far / norm * subgradient), 0.0)
        self._offer(self._at(self._price), self._price, out_of_time)

    def _at(self, price: Floats) -> Standing:
        return Standing.of_best(self.stacks, self.limits, price, self._dual(price)[1])

    def _extra(self) -> int:
        return self._best.excess - self._forced_all

    def _dual(self, price: Floats) -> tuple[float, list[Best]]:
        """Return a lower bound on all plans that exceed capacities by no more than the best one known."""
        extra = self._extra()
        # If the limits alone force that much excess, no such plan exceeds a block's own capacity.
        excess_price = OWN_EXCESS_PRICE if self._is_excess_proven() else float(price.max())
        total = -float(price[:-1] @ self.limits.capacity) - max(0, extra) * float(price.max())
        found = []
        for stack, forced in zip(self.stacks, self._forced, strict=True):
            prices = price[stack.limit]
            best = stack.best(stack.every, prices, excess_price)
            total += float(stack.bound(prices, best, forced, excess_price).sum())
            found.append(best)
        return total, found

    def _subgradient(self, price: Floats, best: Sequence[Best]) -> Floats:
        load = self.limits.loads(
            [np.take_along_axis(stack.limit, found.picks, 1) for stack, found in zip(self.stacks, best, strict=True)]
        )
        subgradient = (load - self.limits.capacity).astype(np.float64)
        extra = self._extra()
        if extra:
            more = sum(int((found.excess - forced).sum()) for found, forced in zip(best, self._forced, strict=True))
            subgradient[int(price[:-1].argmax())] += more - extra
        subgradient[(price[:-1] <= 0) & (subgradient < 0)] = 0.0
        return subgradient

    def _offer(self, standing: Standing, price: Floats, out_of_time: Callable[[], bool]) -> None:
        standing.settle(price, out_of_time)
        if standing.is_better_than(self._best):
            self._best = standing

    def _is_good(self, good_gap: float) -> bool:
        return self._is_excess_proven() and relative_gap(self._best.cost, self._bound, self._best.size) <= good_gap

    def _is_excess_proven(self) -> bool:
        """Return whether nothing is exceeded beyond what each block must by itself, or everything is full and more is
        wanted."""
        extra = self._extra()
        if extra <= 0:
            return True
        if self._forced_all or any(not block.idempotent for stack in self.stacks for block in stack.blocks):
            return False
        if any((stack.limit[:, :-1] == len(self.limits)).any() for stack in self.stacks):
            return False
        return extra <= self._wanted - int(self.limits.capacity.sum())
