"""A valid choice at once."""

from __future__ import annotations

from typing import TYPE_CHECKING

from controlplane.core.plan import block_cost
from controlplane.core.problem import FleetKey, loads, reachable

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from controlplane.core.problem import Block, BlockKey, Choice, Problem


def greedy(problem: Problem) -> dict[BlockKey, Choice]:
    """A valid choice at once: what runs if the time for a better one is too short."""
    free = dict(problem.fleet_capacity)
    choices: dict[BlockKey, Choice] = {}
    for block in problem.blocks:
        choice = _greedy_shared(block, free) if block.idempotent else _greedy_single(block, free)
        choices[block.key] = choice
        for server, load in zip(block.servers, loads(choice, len(block.servers)), strict=True):
            key = FleetKey(server, block.key.service)
            if key in free:
                free[key] -= load
    return choices


def _greedy_shared(block: Block, free: Mapping[FleetKey, int]) -> Choice:
    load = [0] * len(block.servers)
    choice: list[int | None] = []
    for row in block.epsilon:

        def rank(server: int, row: Sequence[float | None] = row) -> tuple[bool, float]:
            limit = free.get(FleetKey(block.servers[server], block.key.service))
            full = (block.capacity and load[server] >= block.capacity) or (limit is not None and load[server] >= limit)
            return bool(full), row[server] or 0.0

        best = min(reachable(row), key=rank)
        load[best] += 1
        choice.append(best)
    return tuple(choice)


def _greedy_single(block: Block, free: Mapping[FleetKey, int]) -> Choice:
    def column(server: int) -> Choice:
        return tuple(server if row[server] is not None else None for row in block.epsilon)

    def rank(server: int) -> tuple[int, float]:
        choice = column(server)
        limit = free.get(FleetKey(block.servers[server], block.key.service))
        over = max(0, loads(choice, len(block.servers))[server] - limit) if limit is not None else 0
        return over, block_cost(block, choice)

    usable = {server for row in block.epsilon for server in reachable(row)}
    return column(min(sorted(usable), key=rank))
