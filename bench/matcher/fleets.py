"""Makes random fleets, and finds their optimum by a minimum-cost flow.

Servers are nearer or farther, interfaces better or worse, and each path differs somewhat from both. The capacity of
every server is its share of all interfaces times `ROOM`.
"""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Any

import numpy as np
from ortools.graph.python import min_cost_flow

from plr.controlplane.core.problem.objectives import epsilon_matrix, path_costs
from plr.controlplane.core.problem.problem import Block, BlockKey, FleetKey, Objective, PairIndex, Problem
from plr.protos.model.ids import InterfaceName, NodeName, ServiceName

SERVICE = ServiceName("/bench")
ROOM = 1.1
MOST_TRIED, TRIED = 20, 4
"""Up to MOST_TRIED servers, each path was tried with each other; beyond, TRIED paths of each interface were."""
FLOW_UNIT = 1e-6
"""Unit of costs in the flow, which counts in integers."""


def random_fleet(
    robots: int, interfaces: int, servers: int, *, seed: int, lifts: bool = False, room: float = ROOM
) -> Problem:
    """Return a fleet that wants the least joint miss probability; with `lifts` pairs of paths tend to fail together."""
    rng = random.Random(seed)
    distances = [0.3 + rng.random() for _ in range(servers)]
    names = tuple(NodeName(f"cloud-{j}") for j in range(servers))
    blocks = tuple(
        random_block(rng, f"robot-{robot}", interfaces, distances, names, lifts=lifts) for robot in range(robots)
    )
    capacity = max(1, int(robots * interfaces * room / servers))
    return Problem(blocks, {FleetKey(name, SERVICE): capacity for name in names}, Objective.JOINT)


def in_regions(problem: Problem, regions: int, *, seed: int) -> Problem:
    """Return the fleet with its servers in this many regions."""
    rng = random.Random(seed)
    labels = tuple(f"region-{rng.randrange(regions)}" for _ in problem.blocks[0].servers)
    return replace(problem, blocks=tuple(replace(block, regions=labels) for block in problem.blocks))


def random_block(
    rng: random.Random, robot: str, interfaces: int, distances: list[float], names: tuple[NodeName, ...], *, lifts: bool
) -> Block:
    """Return one robot of such a fleet."""
    carriers = [10 ** rng.uniform(-3, -0.5) for _ in range(interfaces)]
    found: dict[tuple[PairIndex, PairIndex], float] = {}
    if lifts:
        tried = range(len(names))
        paths = [
            (i, j) for i in range(interfaces) for j in (tried if len(tried) <= MOST_TRIED else rng.sample(tried, TRIED))
        ]
        found = {(one, two): rng.uniform(0.8, 3.0) for one in paths for two in paths if one[0] < two[0]}
    return Block(
        BlockKey(NodeName(robot), SERVICE),
        tuple(InterfaceName(f"if{i}") for i in range(interfaces)),
        names,
        tuple(tuple(min(0.99, carrier * far * rng.uniform(0.3, 3.0)) for far in distances) for carrier in carriers),
        lifts=found,
    )


def flow_optimum(problem: Problem) -> float:
    """Return the least cost of a fleet without lifts: each interface sends a unit to a server over (robot, server)."""
    robots, interfaces = len(problem.blocks), len(problem.blocks[0].interfaces)
    servers = len(problem.blocks[0].servers)
    costs = np.array([path_costs(problem.objective, epsilon_matrix(block)) for block in problem.blocks])
    wanted = robots * interfaces
    of_interface = np.arange(wanted).reshape(robots, interfaces, 1)
    of_both = wanted + np.arange(robots * servers).reshape(robots, 1, servers)
    of_server = wanted + robots * servers + np.arange(servers)
    sink = wanted + robots * servers + servers
    network: Any = min_cost_flow.SimpleMinCostFlow()

    def arcs(tails: Any, heads: Any, capacity: Any, cost: Any) -> None:
        tails, heads, capacity, cost = (part.ravel() for part in np.broadcast_arrays(tails, heads, capacity, cost))
        network.add_arcs_with_capacity_and_unit_cost(
            tails.astype(np.int32), heads.astype(np.int32), capacity.astype(np.int64), cost.astype(np.int64)
        )

    arcs(of_interface, of_both, 1, np.round(costs / FLOW_UNIT))
    arcs(of_both[:, 0, :], of_server, 1, 0)
    limits = [problem.fleet_capacity[FleetKey(name, SERVICE)] for name in problem.blocks[0].servers]
    arcs(of_server, sink, np.array(limits), 0)
    for node in range(wanted):
        network.set_node_supply(node, 1)
    network.set_node_supply(sink, -wanted)
    if network.solve() != network.OPTIMAL:
        raise RuntimeError("the fleet has more interfaces than its servers have room for")
    return float(network.optimal_cost() * FLOW_UNIT)
