"""Stacks find each block's best choice; plans and bounds of the decomposition hold against brute force and a flow."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import pytest
from ortools.graph.python import min_cost_flow

from plr.controlplane.core.problem.objectives import path_costs
from plr.controlplane.core.problem.plan import price
from plr.controlplane.core.problem.problem import Block, FleetKey, Objective, Problem, block_excess, is_valid
from plr.controlplane.core.solve.batch import EnumeratedStack
from plr.controlplane.core.solve.decomposition import Decomposition, stack_blocks
from plr.controlplane.core.solve.enumeration import OWN_EXCESS_PRICE
from plr.controlplane.core.solve.limits import Limits
from tests.unit.controlplane.problems import PLAN, best_price, block, fleet, plain_cost, random_problem, valid_choices

FLOW_UNIT = 1e-6


def never() -> bool:
    return False


@pytest.mark.parametrize("ruled", [False, True])
@pytest.mark.parametrize("objective", Objective)
def test_each_block_gets_its_best_choice_at_any_prices(objective: Objective, ruled: bool) -> None:
    rng = random.Random(41)
    for _ in range(150):
        problem = random_problem(rng, objective, ruled=ruled)
        limits = Limits(problem)
        for stack in stack_blocks(objective, problem.blocks, limits):
            prices = np.array([rng.choice([0.0, rng.random(), 5.0]) for _ in range(stack.servers)] + [0.0])
            found = stack.best(stack.every, np.tile(prices, (len(stack.blocks), 1)))
            for part, value, excess, picks in zip(stack.blocks, *found[:3], strict=True):
                assert is_valid(part, stack.choice_of(picks))
                assert (excess, value) == pytest.approx(best_at(objective, part, prices.tolist()))


def best_at(objective: Objective, part: Block, prices: list[float]) -> tuple[int, float]:
    return min(
        (
            block_excess(part, choice),
            plain_cost(objective, part, choice) + sum(prices[j] for j in choice if j is not None),
        )
        for choice in valid_choices(part)
    )


@pytest.mark.parametrize("ruled", [False, True])
@pytest.mark.parametrize("at_most", [1, 2, 8])
def test_what_is_not_listed_is_not_below_the_bound(at_most: int, ruled: bool) -> None:
    rng = random.Random(44)
    for _ in range(150):
        problem = random_problem(rng, Objective.JOINT, ruled=ruled)
        for part in problem.blocks:
            stack = EnumeratedStack(Objective.JOINT, [part], Limits(problem), at_most=at_most)
            prices = np.array([[*(rng.random() for _ in part.servers), 0.0]])
            found = stack.best(stack.every, prices)
            (bound,) = stack.bound(prices, found, found.excess, OWN_EXCESS_PRICE)
            _, best = best_at(Objective.JOINT, part, prices[0].tolist())
            if found.excess[0] == best_at(Objective.JOINT, part, prices[0].tolist())[0]:
                assert bound <= best + 1e-9
                assert found.value[0] >= best - 1e-9


@pytest.mark.parametrize("capacity", [0, 1, 2, 5])
@pytest.mark.parametrize("interfaces", [4, 5, 7])
def test_many_interfaces_equal_a_flow(interfaces: int, capacity: int) -> None:
    rng = random.Random(interfaces)
    for servers in (1, 3, 9):
        parts = [
            block([[rng.random() for _ in range(servers)] for _ in range(interfaces)], robot=str(k), capacity=capacity)
            for k in range(5)
        ]
        (stack,) = stack_blocks(Objective.SUM, parts, Limits(Problem(())))
        found = stack.best(stack.every, np.zeros((5, servers + 1)))
        for part, value, excess in zip(parts, found.value, found.excess, strict=True):
            cost, exceeded = flow(Problem((part,), {}, Objective.SUM))
            assert excess == exceeded
            assert value == pytest.approx(cost, abs=interfaces * FLOW_UNIT)


@pytest.mark.parametrize("ruled", [False, True])
@pytest.mark.parametrize("objective", Objective)
def test_plans_are_never_below_the_best_nor_bounds_above_it(objective: Objective, ruled: bool) -> None:
    rng = random.Random(42)
    for _ in range(100):
        problem = random_problem(rng, objective, max_choices=2000, ruled=ruled)
        limits = Limits(problem)
        relaxed = Decomposition(problem, limits, {}).run(None, good_gap=0.0, out_of_time=never)
        best = best_price(problem)
        reached = price(problem, relaxed.standing.choices())
        assert (relaxed.standing.excess, relaxed.standing.cost) == pytest.approx((reached.excess, reached.cost))
        assert (reached.excess, reached.cost + 1e-9) >= (best.excess, best.cost)
        if reached.excess == best.excess:
            assert relaxed.bound <= best.cost + 1e-9
        if relaxed.excess_proven:
            assert reached.excess == best.excess


@pytest.mark.parametrize("room", [0.9, 1.0, 1.3])
@pytest.mark.parametrize("objective", [Objective.SUM, Objective.PRODUCT])
def test_a_fleet_is_within_a_percent_of_the_flow(objective: Objective, room: float) -> None:
    problem = fleet(random.Random(43), 150, 2, 12, objective, room)
    relaxed = Decomposition(problem, Limits(problem), {}).run(None, good_gap=0.005, out_of_time=never)
    cost, excess = flow(problem)
    assert relaxed.excess_proven
    assert relaxed.standing.excess == excess
    rounding = 300 * FLOW_UNIT
    assert relaxed.bound <= cost + rounding
    assert cost - rounding <= relaxed.standing.cost <= cost + 0.01 * abs(cost)
    assert relaxed.bound >= cost - 0.02 * abs(cost)


def flow(problem: Problem) -> tuple[float, int]:
    """Least excess and then least cost of a problem without lifts, as a flow: interfaces, block's servers, servers."""
    network: Any = min_cost_flow.SimpleMinCostFlow()
    nodes = {"sink": 0}

    def node(*name: object) -> int:
        return nodes.setdefault(repr(name), len(nodes))

    def arc(tail: int, head: int, capacity: int, cost: float) -> int:
        added: int = network.add_arc_with_capacity_and_unit_cost(tail, head, capacity, round(cost / FLOW_UNIT))
        return added

    over: list[int] = []
    excess_cost = 1000.0
    wanted = 0
    for part in problem.blocks:
        costs = path_costs(problem.objective, np.array(part.epsilon, dtype=float))
        for i in range(len(part.interfaces)):
            wanted += 1
            network.set_node_supply(node(part.key, i), 1)
            for j in np.flatnonzero(np.isfinite(costs[i])).tolist():
                arc(node(part.key, i), node(part.key, "at", j), 1, costs[i, j])
        for j, server in enumerate(part.servers):
            many = len(part.interfaces)
            arc(node(part.key, "at", j), node(server), min(part.capacity or many, many), 0.0)
            over.append(arc(node(part.key, "at", j), node(server), many, excess_cost))
    for server in {server for part in problem.blocks for server in part.servers}:
        arc(node(server), nodes["sink"], problem.fleet_capacity.get(FleetKey(server, PLAN), wanted), 0.0)
        over.append(arc(node(server), nodes["sink"], wanted, excess_cost))
    network.set_node_supply(nodes["sink"], -wanted)
    assert network.solve() == network.OPTIMAL
    excess = sum(network.flow(added) for added in over)
    return network.optimal_cost() * FLOW_UNIT - excess * excess_cost, excess
