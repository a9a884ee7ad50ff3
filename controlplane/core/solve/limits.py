"""Numbers the limits over all robots of a problem, and splits a problem where none of them binds."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from plr.controlplane.core.problem.problem import FleetKey

if TYPE_CHECKING:
    from collections.abc import Sequence
    from collections.abc import Set as AbstractSet

    from numpy.typing import NDArray

    from plr.controlplane.core.problem.problem import Block, Problem


class Limits:
    """Numbers of a problem's limits; the number after the last stands for "no limit"."""

    def __init__(self, problem: Problem) -> None:
        self.keys: tuple[FleetKey, ...] = tuple(problem.fleet_capacity)
        self.capacity: NDArray[np.int64] = np.array([problem.fleet_capacity[key] for key in self.keys], dtype=np.int64)
        self._number = {key: number for number, key in enumerate(self.keys)}

    def __len__(self) -> int:
        return len(self.keys)

    def of_block(self, block: Block) -> list[int]:
        """Return the number of each server's limit."""
        service, without = block.key.service, len(self.keys)
        return [self._number.get(FleetKey(server, service), without) for server in block.servers]

    def loads(self, limits_used: Sequence[NDArray[np.intp]]) -> NDArray[np.int64]:
        """Return how many interfaces each limit holds, given the limit that each interface falls under."""
        count = np.zeros(len(self.keys) + 1, dtype=np.int64)
        for used in limits_used:
            count += np.bincount(used.ravel(), minlength=len(self.keys) + 1)
        return count[:-1]


def independent_groups(problem: Problem) -> list[Problem]:
    """Split into problems that share no limit over all robots which could bind; each is solved on its own.

    Each part names the limits that could bind, so none for a block on its own.
    """
    wanted: dict[FleetKey, int] = {}
    for block in problem.blocks:
        for key in _limits(problem, block):
            wanted[key] = wanted.get(key, 0) + block.copies_wanted.most
    binding = {key for key, count in wanted.items() if count > problem.fleet_capacity[key]}
    groups: dict[int, list[Block]] = {}
    leader: dict[FleetKey, int] = {}
    for number, block in enumerate(problem.blocks):
        shared = [key for key in _limits(problem, block) if key in binding]
        joined = {leader[key] for key in shared if key in leader}
        target = min(joined, default=number)
        members = groups.setdefault(target, [])
        members.append(block)
        for other in joined - {target}:
            members.extend(groups.pop(other))
            for key, lead in leader.items():
                if lead == other:
                    leader[key] = target
        leader.update(dict.fromkeys(shared, target))
    return [_part(problem, members, binding) for members in groups.values()]


def _limits(problem: Problem, block: Block) -> list[FleetKey]:
    keys = (FleetKey(server, block.key.service) for server in block.servers)
    return [key for key in keys if key in problem.fleet_capacity]


def _part(problem: Problem, blocks: Sequence[Block], binding: AbstractSet[FleetKey]) -> Problem:
    keys = dict.fromkeys(key for block in blocks for key in _limits(problem, block) if key in binding)
    return replace(problem, blocks=tuple(blocks), fleet_capacity={key: problem.fleet_capacity[key] for key in keys})
