"""The assignment problem of the paper (section on the matcher).

A block is one robot's use of one service: its interfaces i, the servers j, and epsilon_ij, the probability that a
request sent over i to j misses the deadline. Binary x_ij; every interface gets exactly one server; at most
`capacity` interfaces of the block share a server (the paper's is 1). What is minimised stands in `objectives`.

Beyond the paper:

- A server may limit how many interfaces of all robots it serves (`Problem.fleet_capacity`).
- A service that is not idempotent goes to one server over all interfaces; capacity within the block does not apply.
- Where no assignment keeps to the capacities, they are exceeded by the least total number of interfaces, and the
  plan says by how many. So a plan exists for every problem.
"""

from __future__ import annotations

import enum
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from controlplane.core.posterior import Estimate

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from protos.model import InterfaceName, NodeName, ServiceName


class BlockKey(NamedTuple):
    """Whose requests for what."""

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


Path = tuple[int, int]
"""Indices of an interface and of a server in a block."""


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
    lifts: Mapping[tuple[Path, Path], float] = field(default_factory=dict)
    """P(both miss) / (epsilon_1 epsilon_2) of two paths, that of the lower interface first; 1 where not named."""
    weights: tuple[tuple[float, ...], ...] = ()
    """By interface, then server: how many independent requests that epsilon is worth; empty if all are exact."""

    def estimate(self, path: Path) -> Estimate | None:
        """What is believed of a path's miss probability; None if there is no path, or its epsilon is exact."""
        interface, server = path
        epsilon = self.epsilon[interface][server]
        if epsilon is None or not self.weights:
            return None
        return Estimate.of(epsilon, self.weights[interface][server])


@dataclass(frozen=True, slots=True)
class Problem:
    """All blocks, and what limits them together."""

    blocks: tuple[Block, ...]
    fleet_capacity: Mapping[FleetKey, int] = field(default_factory=dict)
    """Interfaces of all robots that a server may serve for a service; those not named have no limit."""
    objective: Objective = Objective.JOINT


Choice = tuple[int | None, ...]
"""For each interface of a block the index of its server; None where the one server of a service that is not
idempotent cannot be reached over it."""


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


def limits_used(problem: Problem, block: Block, choice: Choice) -> list[FleetKey]:
    """For each interface the limit over all robots that it falls under, where it does."""
    keys = [FleetKey(block.servers[server], block.key.service) for server in choice if server is not None]
    return [key for key in keys if key in problem.fleet_capacity]


def fleet_excess(problem: Problem, choices: Mapping[BlockKey, Choice]) -> dict[FleetKey, int]:
    """By how many interfaces the choices exceed each limit over all robots; only those exceeded."""
    load = Counter(key for block in problem.blocks for key in limits_used(problem, block, choices[block.key]))
    return {key: load[key] - limit for key, limit in problem.fleet_capacity.items() if load[key] > limit}


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


def reachable(row: Iterable[float | None]) -> list[int]:
    """The servers to which an interface's row has a path."""
    return [server for server, epsilon in enumerate(row) if epsilon is not None]
