"""The matcher's plans equal brute force, and no problem is without an answer."""

from __future__ import annotations

import random
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from plr.controlplane.core.problem.plan import price
from plr.controlplane.core.problem.problem import Block, FleetKey, Objective, Problem, Target, is_valid
from plr.controlplane.solver.cp_sat import RESOLUTION
from plr.controlplane.solver.matcher import Matcher, solve
from plr.protos.model.ids import NodeName
from plr.protos.model.members import AT_MOST_EVERY_INTERFACE, Copies
from tests.unit.controlplane.problems import PLAN, best_price, block, choices_of, fleet, random_problem

AMPLE_S = 60.0


@pytest.mark.parametrize("ruled", [False, True])
@pytest.mark.parametrize("objective", Objective)
@pytest.mark.parametrize("seed", range(10))
def test_equals_brute_force(seed: int, objective: Objective, ruled: bool) -> None:
    rng = random.Random(seed)
    for number in range(40):
        problem = random_problem(rng, objective, max_choices=3_000, limited=number % 3 > 0, ruled=ruled)
        plan = solve(problem, time_limit_s=AMPLE_S)
        assert plan.unproven == 0
        choices = choices_of(problem, {key: made.assignments for key, made in plan.blocks.items()})
        assert all(is_valid(part, choices[part.key]) for part in problem.blocks)
        found, best = price(problem, choices), best_price(problem)
        assert found.excess == best.excess == plan.relaxed
        assert found.cost == pytest.approx(best.cost, abs=len(problem.blocks) * 2 * RESOLUTION)
        assert found.cost == pytest.approx(plan.cost)
        assert plan.bound <= best.cost + len(problem.blocks) * 2 * RESOLUTION
        assert plan.gap < 1e-5


@pytest.mark.parametrize("objective", [Objective.SUM, Objective.PRODUCT])
def test_one_robot_alone_is_the_assignment_problem(objective: Objective) -> None:
    rng = random.Random(5)
    for _ in range(200):
        interfaces = rng.randint(1, 6)
        servers = rng.randint(interfaces, 12)
        epsilon: list[list[float | None]] = [[rng.random() for _ in range(servers)] for _ in range(interfaces)]
        plan = solve(Problem((block(epsilon),), {}, objective), time_limit_s=AMPLE_S)
        table = np.array(epsilon, dtype=float)
        costs = table if objective is Objective.SUM else np.log(table)
        assert plan.cost == pytest.approx(costs[linear_sum_assignment(costs)].sum())


def test_the_paper_gives_two_interfaces_one_server_each() -> None:
    part = block([[0.01, 0.02], [0.01, 0.30]])
    made = solve(Problem((part,)), time_limit_s=AMPLE_S).blocks[part.key]
    assert made.assignments == (("if0", "cloud-1"), ("if1", "cloud-0"))
    assert made.excess == 0


def test_more_interfaces_than_capacity_is_relaxed_by_the_least() -> None:
    part = block([[0.1, 0.2], [0.1, 0.2], [0.1, 0.2]])
    plan = solve(Problem((part,), objective=Objective.SUM), time_limit_s=AMPLE_S)
    assert plan.relaxed == plan.blocks[part.key].excess == 1
    assert len(plan.blocks[part.key].assignments) == 3
    assert plan.blocks[part.key].cost == pytest.approx(0.1 + 0.1 + 0.2)


def test_interfaces_that_reach_only_one_server_are_relaxed_there() -> None:
    part = block([[0.1, None], [0.2, None]])
    plan = solve(Problem((part,)), time_limit_s=AMPLE_S)
    assert plan.relaxed == 1
    assert {server for _, server in plan.blocks[part.key].assignments} == {"cloud-0"}


def test_a_limit_over_all_robots_is_shared() -> None:
    one = block([[0.1, 0.5]], robot="one")
    two = block([[0.1, 0.2]], robot="two")
    problem = Problem((one, two), {FleetKey(NodeName("cloud-0"), PLAN): 1})
    plan = solve(problem, time_limit_s=AMPLE_S)
    assert plan.blocks[one.key].assignments == (("if0", "cloud-0"),)
    assert plan.blocks[two.key].assignments == (("if0", "cloud-1"),)
    assert plan.relaxed == 0


def test_a_limit_over_all_robots_is_relaxed_by_the_least() -> None:
    robots = [block([[0.1]], robot=f"robot-{number}") for number in range(4)]
    key = FleetKey(NodeName("cloud-0"), PLAN)
    plan = solve(Problem(tuple(robots), {key: 1}), time_limit_s=AMPLE_S)
    assert plan.fleet_excess == {key: 3}
    assert plan.relaxed == 3


def test_what_is_not_idempotent_goes_to_one_server_chosen_over_all_interfaces() -> None:
    part = block([[0.01, 0.1], [0.9, 0.1]], idempotent=False)
    made = solve(Problem((part,), objective=Objective.SUM), time_limit_s=AMPLE_S).blocks[part.key]
    assert made.assignments == (("if0", "cloud-1"), ("if1", "cloud-1"))
    assert made.excess == 0


def test_nothing_to_assign_gives_an_empty_plan() -> None:
    plan = solve(Problem(()), time_limit_s=AMPLE_S)
    assert plan.blocks == {}
    assert plan.relaxed == 0


def test_out_of_time_there_is_still_a_valid_plan() -> None:
    rng = random.Random(3)
    robots = [
        block([[rng.random() for _ in range(20)] for _ in range(4)], robot=f"robot-{number}") for number in range(40)
    ]
    limits = {FleetKey(NodeName(f"cloud-{j}"), PLAN): 8 for j in range(20)}
    problem = Problem(tuple(robots), limits)
    first = solve(problem, time_limit_s=1e-9)
    choices = choices_of(problem, {key: made.assignments for key, made in first.blocks.items()})
    assert all(is_valid(part, choices[part.key]) for part in problem.blocks)
    hinted = solve(problem, time_limit_s=1e-9, hint=first)
    assert sum(made.cost for made in hinted.blocks.values()) <= sum(made.cost for made in first.blocks.values()) + 1e-4


def test_the_same_problem_gives_the_same_plan() -> None:
    problem = random_problem(random.Random(21))
    assert solve(problem, time_limit_s=AMPLE_S) == solve(problem, time_limit_s=AMPLE_S)


def test_one_robot_that_changes_is_solved_alone_and_within_what_the_others_leave() -> None:
    rng = random.Random(6)
    problem = fleet(rng, 120, 2, 12, Objective.JOINT, 1.1)
    matcher = Matcher()
    before = matcher.solve(problem, time_limit_s=AMPLE_S)
    for round_ in range(1, 21):
        number = rng.randrange(len(problem.blocks))
        problem = with_block(problem, number, fleet(rng, 1, 2, 12, Objective.JOINT, 1.0).blocks[0].epsilon)
        plan = matcher.solve(problem, time_limit_s=AMPLE_S)
        if matcher.incremental == round_:
            moved = [key for key in plan.blocks if plan.blocks[key] != before.blocks[key]]
            assert set(moved) <= {problem.blocks[number].key}
        again = price(problem, choices_of(problem, {key: made.assignments for key, made in plan.blocks.items()}))
        assert again.excess == 0
        assert again.cost == pytest.approx(plan.cost)
        best = solve(problem, time_limit_s=AMPLE_S)
        assert plan.bound <= best.cost
        assert plan.gap <= 0.01
        before = plan
    assert matcher.incremental >= 15


def test_robots_that_leave_and_come_need_no_other_to_move() -> None:
    problem = fleet(random.Random(7), 100, 2, 12, Objective.JOINT, 1.1)
    matcher = Matcher()
    matcher.solve(problem, time_limit_s=AMPLE_S)
    fewer = replace(problem, blocks=problem.blocks[1:])
    left = matcher.solve(fewer, time_limit_s=AMPLE_S)
    assert left.blocks.keys() == {part.key for part in fewer.blocks}
    back = matcher.solve(problem, time_limit_s=AMPLE_S)
    assert back.blocks.keys() == {part.key for part in problem.blocks}
    assert back.relaxed == 0
    assert matcher.incremental == 2
    assert matcher.solve(problem, time_limit_s=AMPLE_S) == back


def test_a_fleet_with_rules_shares_servers_within_the_capacities_and_near_the_bound() -> None:
    rng = random.Random(9)
    problem = fleet(rng, 100, 3, 12, Objective.JOINT, 1.1)
    problem = replace(problem, blocks=tuple(ruled(rng, part) for part in problem.blocks))
    matcher = Matcher()
    plan = matcher.solve(problem, time_limit_s=AMPLE_S)
    assert plan.relaxed == 0
    assert plan.gap <= 0.01
    choices = choices_of(problem, {key: made.assignments for key, made in plan.blocks.items()})
    assert all(is_valid(part, choices[part.key]) for part in problem.blocks)
    assert price(problem, choices).cost == pytest.approx(plan.cost)
    plain = [plan.blocks[part.key] for part in problem.blocks if part.target is None]
    assert sum(bool(made.shared) for made in plain) <= 0.05 * len(plain), "there are three regions and carriers"
    met = [not made.shortfall for made in plan.blocks.values() if made.target_miss]
    assert sum(met) >= 0.9 * len(met)
    problem = with_block(problem, 3, problem.blocks[4].epsilon)
    again = matcher.solve(problem, time_limit_s=AMPLE_S)
    assert matcher.incremental == 1
    assert again.bound <= solve(problem, time_limit_s=AMPLE_S).cost


@pytest.mark.parametrize("time_limit_s", [1e-9, AMPLE_S])
def test_a_fleet_with_too_many_choices_to_list_keeps_to_the_capacities(time_limit_s: float) -> None:
    rng = random.Random(10)
    problem = fleet(rng, 80, 4, 16, Objective.JOINT, 1.1)
    regions = tuple(("eu", "us", "asia")[number % 3] for number in range(16))
    # All lifts of a few paths each, as those have that carried requests together.
    blocks = []
    for part in problem.blocks:
        tried = [(i, j) for i in range(4) for j in rng.sample(range(16), 2)]
        lifts = {(one, two): rng.uniform(0.7, 3.0) for one in tried for two in tried if one[0] < two[0]}
        blocks.append(replace(part, regions=regions, lifts=lifts))
    problem = replace(problem, blocks=tuple(blocks))
    plan = solve(problem, time_limit_s=time_limit_s)
    assert plan.relaxed == 0
    choices = choices_of(problem, {key: made.assignments for key, made in plan.blocks.items()})
    assert price(problem, choices).cost == pytest.approx(plan.cost)
    assert plan.bound <= plan.cost
    if time_limit_s == AMPLE_S:
        assert plan.gap <= 0.01
        assert all(len(made.shared) == 1 for made in plan.blocks.values()), "four copies, three regions"


def ruled(rng: random.Random, part: Block) -> Block:
    """Three regions and carriers; two copies of the one half's requests, the other half cheap."""
    regions = tuple(("eu", "us", "asia")[number % 3] for number in range(len(part.servers)))
    labelled = replace(part, regions=regions, carriers=("a", "a", "b"))
    if rng.random() < 0.5:
        return replace(labelled, copies=Copies(2, 2))
    charges = tuple(tuple(float(rng.randint(1, 9)) for _ in part.servers) for _ in part.interfaces)
    return replace(labelled, copies=AT_MOST_EVERY_INTERFACE, target=Target(0.01, charges))


def test_what_all_share_changes_all() -> None:
    problem = fleet(random.Random(8), 100, 2, 12, Objective.JOINT, 1.1)
    matcher = Matcher()
    matcher.solve(problem, time_limit_s=AMPLE_S)
    key, limit = next(iter(problem.fleet_capacity.items()))
    smaller = replace(problem, fleet_capacity={**problem.fleet_capacity, key: limit - 5})
    assert matcher.solve(smaller, time_limit_s=AMPLE_S).relaxed == 0
    many = replace(problem, blocks=tuple(replace(part, capacity=2) for part in problem.blocks))
    assert matcher.solve(many, time_limit_s=AMPLE_S).relaxed == 0
    assert matcher.incremental == 0


def with_block(problem: Problem, number: int, epsilon: tuple[tuple[float | None, ...], ...]) -> Problem:
    blocks = list(problem.blocks)
    blocks[number] = replace(blocks[number], epsilon=epsilon)
    return replace(problem, blocks=tuple(blocks))
