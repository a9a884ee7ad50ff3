"""Splitting a problem into parts that are solved on their own."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from controlplane.core.problem.problem import FleetKey

if TYPE_CHECKING:
    from collections.abc import Sequence
    from collections.abc import Set as AbstractSet

    from controlplane.core.problem.problem import Block, Problem


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
