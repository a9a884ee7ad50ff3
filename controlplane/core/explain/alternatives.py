"""Computes what other mappings of one robot's service would give, and what speaks against those that look better."""

from __future__ import annotations

import itertools
from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from plr.controlplane.core.problem.costs import block_cost, charge, choice_costs
from plr.controlplane.core.problem.domains import shared_domains
from plr.controlplane.core.problem.plan import choice_of
from plr.controlplane.core.problem.problem import FleetKey, block_excess, loads, reachable
from plr.controlplane.core.solve.enumeration import MAX_LISTED_CHOICES, list_choices, own_excess
from plr.protos.model.explanation import Alternative, AlternativeKind
from plr.protos.model.mapping import Assignment

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from plr.controlplane.core.problem.plan import Plan
    from plr.controlplane.core.problem.problem import Block, Choice, Problem
    from plr.protos.model.ids import NodeName

OTHERS = 3
"""Number of the best mappings reported that are not in force."""


def of(problem: Problem, plan: Plan, block: Block, miss: Callable[[Block, Choice], float]) -> tuple[Alternative, ...]:
    """Return the best other mappings of the block, each interface alone, and the block without each server in use;
    `miss` tells what requests miss with a choice."""
    running = choice_of(block, plan.blocks.get(block.key))
    return _Alternatives(problem, plan, block, running, miss).all()


class _Alternatives:
    def __init__(
        self,
        problem: Problem,
        plan: Plan,
        block: Block,
        running: Choice | None,
        miss: Callable[[Block, Choice], float],
    ) -> None:
        self._miss = miss
        self._problem = problem
        self._block = block
        self._running = running
        self._taken = _taken_by_others(problem, plan, block)
        choices = list_choices(block, MAX_LISTED_CHOICES).choices
        costs = choice_costs(problem.objective, block, choices)
        self._choices = choices[np.lexsort((costs, own_excess(block, choices)))]

    def all(self) -> tuple[Alternative, ...]:
        return (*self._others(), *self._alone(), *self._without())

    def _others(self) -> Iterator[Alternative]:
        ranked = (_choice(row) for row in self._choices)
        for choice in itertools.islice((choice for choice in ranked if choice != self._running), OTHERS):
            yield self._told(AlternativeKind.OTHER, choice)

    def _alone(self) -> Iterator[Alternative]:
        rows = self._block.epsilon
        if len(rows) < 2:
            return
        for number, row in enumerate(rows):
            best = min(reachable(row), key=lambda server: (row[server], server))
            choice: list[int | None] = [None] * len(rows)
            choice[number] = best
            yield self._told(AlternativeKind.ALONE, tuple(choice))

    def _without(self) -> Iterator[Alternative]:
        for server in sorted({server for server in self._running or () if server is not None}):
            name = self._block.servers[server]
            left = self._choices[(self._choices != server).all(axis=1)]
            if len(left):
                yield self._told(AlternativeKind.WITHOUT, _choice(left[0]), without=name)
            else:
                yield Alternative(AlternativeKind.WITHOUT, (), 1.0, name, "nothing is left for an interface")

    def _told(self, kind: AlternativeKind, choice: Choice, without: NodeName | None = None) -> Alternative:
        block = self._block
        pairs = zip(block.interfaces, choice, strict=True)
        assignments = tuple(Assignment(nic, block.servers[server]) for nic, server in pairs if server is not None)
        note = "; ".join(self._against(choice)) if kind is AlternativeKind.OTHER else ""
        cost = charge(block.target, choice) if block.target is not None else None
        return Alternative(kind, assignments, self._miss(block, choice), without, note, cost)

    def _against(self, choice: Choice) -> Iterator[str]:
        block = self._block
        excess = block_excess(block, choice)
        if excess:
            yield f"capacity for one robot exceeded by {excess}"
        full = [
            server
            for server, load in zip(block.servers, loads(choice, len(block.servers)), strict=True)
            if load and self._is_full(server, load)
        ]
        if full:
            yield f"other robots leave no room on {', '.join(full)}"
        shared = shared_domains(block, choice)
        if shared:
            yield f"copies share {', '.join(shared)}"
        if self._running is None or excess or full:
            return
        objective = self._problem.objective
        if block_cost(objective, block, choice) < block_cost(objective, block, self._running):
            yield "better, but not by enough to move"

    def _is_full(self, server: NodeName, load: int) -> bool:
        limit = self._problem.fleet_capacity.get(FleetKey(server, self._block.key.service))
        return limit is not None and self._taken[server] + load > limit


def _taken_by_others(problem: Problem, plan: Plan, block: Block) -> Counter[NodeName]:
    """Return how many interfaces of other robots each server serves for this service."""
    return Counter(
        server
        for key, other in plan.blocks.items()
        if key.service == block.key.service and key.robot != block.key.robot
        for _, server in other.assignments
    )


def _choice(row: Sequence[int] | NDArray[np.intp]) -> Choice:
    return tuple(None if server < 0 else int(server) for server in row)
