"""Defines the assignment problem of the paper (section on the matcher).

A block is one robot's use of one service: its interfaces i, the servers j, and epsilon_ij, the probability that a
request sent over i to j misses the deadline. Binary x_ij; every interface gets exactly one server; at most `capacity`
interfaces of the block share a server (the paper's is 1). `objectives` and `costs` define what is minimised.

Beyond the paper:

- Fewer copies than interfaces: at most one for each, or a number of them (`Copies`).
- Failure domains: servers have regions and interfaces have carriers, which copies should not share (`domains`).
- A block may have a target instead of the objective: the least charge that keeps its miss probability below it. The
  charge of a choice is the sum of its copies' `cost_per_request`; "cost" is what the solver minimises.
- A server may limit how many interfaces of all robots it serves (`Problem.fleet_capacity`).
- A service that is not idempotent goes to one server over all interfaces; capacity within the block does not apply.
- If no assignment keeps to the capacities, they are exceeded by the least total number of interfaces, and the
  plan says by how many. So a plan exists for every problem.
"""

from __future__ import annotations

import enum
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from plr.controlplane.core.estimate.posterior import Estimate
from plr.protos.model.members import EVERY_INTERFACE, Copies

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from plr.protos.model.ids import InterfaceName, NodeName, ServiceName


class BlockKey(NamedTuple):
    """Identifies one robot's use of one service."""

    robot: NodeName
    service: ServiceName


class FleetKey(NamedTuple):
    """A server's limit over all robots for one service."""

    server: NodeName
    service: ServiceName


class Objective(enum.Enum):
    """What is minimised, summed over all blocks."""

    SUM = "sum"
    """The sum of epsilon_ij over the chosen pairs: the paper's."""
    PRODUCT = "product"
    """The logarithm of their product, the probability that all miss if paths fail independently."""
    JOINT = "joint"
    """The logarithm of the probability that all miss, with the measured lift of each pair of paths."""


PairIndex = tuple[int, int]
"""Indices of an interface and of a server in a block."""


@dataclass(frozen=True, slots=True)
class Target:
    """Target of a service that wants to be cheap while it misses few enough deadlines."""

    miss: float
    """Maximum probability that all copies miss."""
    charges: tuple[tuple[float, ...], ...]
    """What a copy of a request costs, by interface, then server; in any one currency, not negative."""


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
    lifts: Mapping[tuple[PairIndex, PairIndex], float] = field(default_factory=dict)
    """P(both miss) / (epsilon_1 epsilon_2) of two paths, that of the lower interface first; 1 if not named."""
    weights: tuple[tuple[float, ...], ...] = ()
    """By interface, then server: how many independent requests that epsilon is worth; empty if all are exact."""

    copies: Copies = EVERY_INTERFACE
    regions: tuple[str, ...] = ()
    """Region of each server; an empty text if unknown, an empty tuple if none is known."""
    carriers: tuple[str, ...] = ()
    """Carrier of each interface, likewise."""
    target: Target | None = None
    """None: as reliable as possible."""

    @property
    def copies_wanted(self) -> Copies:
        """Number of copies, for the present number of interfaces."""
        return self.copies.over(len(self.interfaces))

    def estimate(self, path: PairIndex) -> Estimate | None:
        """Return what is believed of a path's miss probability; None if there is no path, or its epsilon is exact."""
        interface, server = path
        epsilon = self.epsilon[interface][server]
        if epsilon is None or not self.weights:
            return None
        return Estimate.of(epsilon, self.weights[interface][server])


@dataclass(frozen=True, slots=True)
class Problem:
    """All blocks, and their common limits."""

    blocks: tuple[Block, ...]
    fleet_capacity: Mapping[FleetKey, int] = field(default_factory=dict)
    """Interfaces of all robots that a server may serve for a service; servers not named have no limit."""
    objective: Objective = Objective.JOINT


Choice = tuple[int | None, ...]
"""For each interface of a block the index of its server; None if it carries no copy."""


def loads(choice: Choice, servers: int) -> list[int]:
    """Return how many interfaces each server gets."""
    count = [0] * servers
    for server in choice:
        if server is not None:
            count[server] += 1
    return count


def crowding(block: Block, choice: Choice) -> int:
    """Return how many interfaces share a server beyond the block's own capacity."""
    if not block.capacity or not block.idempotent:
        return 0
    return sum(max(0, load - block.capacity) for load in loads(choice, len(block.servers)))


def limits_used(problem: Problem, block: Block, choice: Choice) -> list[FleetKey]:
    """Return the limits over all robots that the choice's interfaces fall under, one for each that has one."""
    keys = [FleetKey(block.servers[server], block.key.service) for server in choice if server is not None]
    return [key for key in keys if key in problem.fleet_capacity]


def block_excess(block: Block, choice: Choice) -> int:
    """Return by how many interfaces the choice exceeds what no block should; 0 for a block with a target, which has its
    own ranking (`costs`)."""
    return 0 if block.target is not None else crowding(block, choice)


def fleet_excess(problem: Problem, choices: Mapping[BlockKey, Choice]) -> dict[FleetKey, int]:
    """Return by how many interfaces the choices exceed each limit over all robots; only exceeded ones are listed."""
    load = Counter(key for block in problem.blocks for key in limits_used(problem, block, choices[block.key]))
    return {key: load[key] - limit for key, limit in problem.fleet_capacity.items() if load[key] > limit}


def is_valid(block: Block, choice: Choice) -> bool:
    """Return whether the choice uses only existing paths, as many as the block wants, and, for a service that is not
    idempotent, one server, over as many of the interfaces as are wanted and reach it."""
    if len(choice) != len(block.interfaces):
        return False
    for row, server in zip(block.epsilon, choice, strict=True):
        if server is not None and row[server] is None:
            return False
    used = [server for server in choice if server is not None]
    least, most = block.copies_wanted
    if not block.idempotent and used:
        least = min(least, sum(row[used[0]] is not None for row in block.epsilon))
    if not (max(1, least) <= len(used) <= most):
        return False
    return block.idempotent or len(set(used)) == 1


def reachable(row: Iterable[float | None]) -> list[int]:
    """Return the servers to which an interface's row has a path."""
    return [server for server, epsilon in enumerate(row) if epsilon is not None]
