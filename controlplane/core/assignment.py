"""The assignment problem of the paper (section on the matcher), and what a plan for it costs.

A block is one robot's use of one service: its interfaces i, the servers j, and epsilon_ij, the probability that a
request sent over i to j misses the deadline. Binary x_ij; every interface gets exactly one server; at most
`capacity` interfaces of the block share a server (the paper's is 1); minimise the sum of epsilon_ij x_ij.

Beyond the paper:

- A server may limit how many interfaces of all robots it serves (`Problem.fleet_capacity`).
- A service that is not idempotent goes to one server over all interfaces; capacity within the block does not apply.
- Where no assignment keeps to the capacities, they are exceeded by the least total number of interfaces, and the
  plan says by how many. So a plan exists for every problem.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from protos.model import InterfaceName, NodeName, ServiceName

MAX_REASON_SERVERS = 3
"""Servers named in a reason before it says "and others": a reason is one short line."""


class BlockKey(NamedTuple):
    """Whose requests for what."""

    robot: NodeName
    service: ServiceName


class FleetKey(NamedTuple):
    """A server's limit over all robots for one service."""

    server: NodeName
    service: ServiceName


@dataclass(frozen=True, slots=True)
class Block:
    """One robot's use of one service. Every interface can reach at least one of the servers."""

    key: BlockKey
    interfaces: tuple[InterfaceName, ...]
    servers: tuple[NodeName, ...]
    epsilon: tuple[tuple[float | None, ...], ...]
    """By interface, then server; None where there is no path."""
    capacity: int = 1
    """Interfaces of this block that may share a server; 0 means no limit."""
    idempotent: bool = True


@dataclass(frozen=True, slots=True)
class Problem:
    """All blocks, and what limits them together."""

    blocks: tuple[Block, ...]
    fleet_capacity: Mapping[FleetKey, int] = field(default_factory=dict)
    """Interfaces of all robots that a server may serve for a service; those not named have no limit."""


Choice = tuple[int | None, ...]
"""For each interface of a block the index of its server; None where the one server of a service that is not
idempotent cannot be reached over it."""


@dataclass(frozen=True, slots=True)
class BlockPlan:
    """Where one block's requests go."""

    key: BlockKey
    assignments: tuple[tuple[InterfaceName, NodeName], ...]
    cost: float
    """The sum that is minimised: of epsilon_ij, with 1 for an interface without a server."""
    predicted_miss: float
    """Probability that all copies miss, if the paths fail independently: the product of epsilon_ij."""
    excess: int = 0
    """By how many interfaces the block's own capacity is exceeded."""


@dataclass(frozen=True, slots=True)
class Plan:
    """A plan for a problem."""

    blocks: Mapping[BlockKey, BlockPlan]
    fleet_excess: Mapping[FleetKey, int] = field(default_factory=dict)
    """By how many interfaces a server's limit over all robots is exceeded; only those that are."""
    unproven: int = 0
    """Groups of blocks whose optimum could not be proven in the time given."""

    @property
    def relaxed(self) -> int:
        """By how many interfaces capacities are exceeded in all."""
        return sum(block.excess for block in self.blocks.values()) + sum(self.fleet_excess.values())


@dataclass(frozen=True, order=True, slots=True)
class Price:
    """What a plan costs; ordered: first keep to the capacities, then miss few deadlines."""

    excess: int
    cost: float


def block_cost(block: Block, choice: Choice) -> float:
    """The sum of epsilon_ij over the chosen pairs, with 1 for an interface without a server."""
    total = 0.0
    for row, server in zip(block.epsilon, choice, strict=True):
        epsilon = row[server] if server is not None else None
        total += 1.0 if epsilon is None else epsilon
    return total


def loads(choice: Choice, servers: int) -> list[int]:
    """How many interfaces each server gets."""
    count = [0] * servers
    for server in choice:
        if server is not None:
            count[server] += 1
    return count


def block_excess(block: Block, choice: Choice) -> int:
    """By how many interfaces the choice exceeds the block's own capacity."""
    if not block.capacity or not block.idempotent:
        return 0
    return sum(max(0, load - block.capacity) for load in loads(choice, len(block.servers)))


def fleet_excess(problem: Problem, choices: Mapping[BlockKey, Choice]) -> dict[FleetKey, int]:
    """By how many interfaces the choices exceed each limit over all robots; only those exceeded."""
    load: dict[FleetKey, int] = {}
    for block in problem.blocks:
        for server, count in zip(block.servers, loads(choices[block.key], len(block.servers)), strict=True):
            key = FleetKey(server, block.key.service)
            load[key] = load.get(key, 0) + count
    return {key: load[key] - limit for key, limit in problem.fleet_capacity.items() if load.get(key, 0) > limit}


def is_valid(block: Block, choice: Choice) -> bool:
    """Whether the choice uses only paths that exist, leaves out no interface it need not, and, for a service that
    is not idempotent, names one server."""
    if len(choice) != len(block.interfaces):
        return False
    for row, server in zip(block.epsilon, choice, strict=True):
        if server is not None and row[server] is None:
            return False
    used = {server for server in choice if server is not None}
    if block.idempotent:
        return None not in choice
    if len(used) != 1:
        return False
    (only,) = used
    return all((server is None) == (row[only] is None) for row, server in zip(block.epsilon, choice, strict=True))


def price(problem: Problem, choices: Mapping[BlockKey, Choice]) -> Price:
    """What choices cost, of which each must be valid."""
    excess = sum(block_excess(block, choices[block.key]) for block in problem.blocks)
    excess += sum(fleet_excess(problem, choices).values())
    return Price(excess, sum(block_cost(block, choices[block.key]) for block in problem.blocks))


def make_plan(problem: Problem, choices: Mapping[BlockKey, Choice], *, unproven: int = 0) -> Plan:
    """Write choices down as a plan."""
    plans: dict[BlockKey, BlockPlan] = {}
    for block in problem.blocks:
        choice = choices[block.key]
        pairs = [(i, j) for i, j in enumerate(choice) if j is not None]
        plans[block.key] = BlockPlan(
            key=block.key,
            assignments=tuple((block.interfaces[i], block.servers[j]) for i, j in pairs),
            cost=block_cost(block, choice),
            predicted_miss=math.prod(block.epsilon[i][j] or 0.0 for i, j in pairs) if pairs else 1.0,
            excess=block_excess(block, choice),
        )
    return Plan(plans, fleet_excess(problem, choices), unproven)


def choice_of(block: Block, plan: BlockPlan | None) -> Choice | None:
    """The plan's choice in the block's present numbering; None if it is not valid there any more."""
    if plan is None:
        return None
    server_of = dict(plan.assignments)
    index = {server: number for number, server in enumerate(block.servers)}
    choice: list[int | None] = []
    for interface in block.interfaces:
        server = server_of.get(interface)
        if server is not None and server not in index:
            return None
        choice.append(index[server] if server is not None else None)
    found = tuple(choice)
    return found if is_valid(block, found) else None


def independent_groups(problem: Problem) -> list[Problem]:
    """Split into problems that share no limit over all robots which could bind; each is solved on its own."""
    wanted: dict[FleetKey, int] = {}
    for block in problem.blocks:
        for key in _limits(problem, block):
            wanted[key] = wanted.get(key, 0) + len(block.interfaces)
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
    return [_part(problem, members) for members in groups.values()]


def _limits(problem: Problem, block: Block) -> list[FleetKey]:
    keys = (FleetKey(server, block.key.service) for server in block.servers)
    return [key for key in keys if key in problem.fleet_capacity]


def _part(problem: Problem, blocks: Sequence[Block]) -> Problem:
    keys = {key for block in blocks for key in _limits(problem, block)}
    return Problem(tuple(blocks), {key: problem.fleet_capacity[key] for key in keys})


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

        best = min(_reachable(row), key=rank)
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

    usable = {server for row in block.epsilon for server in _reachable(row)}
    return column(min(sorted(usable), key=rank))


def _reachable(row: Iterable[float | None]) -> list[int]:
    return [server for server, epsilon in enumerate(row) if epsilon is not None]
