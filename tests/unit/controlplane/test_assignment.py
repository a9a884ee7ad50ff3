"""Validity, price, grouping and the greedy start of assignment problems."""

from __future__ import annotations

import random

import pytest

from controlplane.core.greedy import greedy
from controlplane.core.grouping import independent_groups
from controlplane.core.plan import Price, choice_of, make_plan, price
from controlplane.core.problem import FleetKey, Problem, fleet_excess, is_valid
from protos.model import NodeName
from tests.unit.controlplane.problems import PLAN, best_price, block, random_problem

CLOUD_0 = FleetKey(NodeName("cloud-0"), PLAN)
CLOUD_1 = FleetKey(NodeName("cloud-1"), PLAN)


def test_price_puts_capacity_before_misses() -> None:
    part = block([[0.1, 0.9], [0.1, 0.9]])
    problem = Problem((part,))
    assert price(problem, {part.key: (0, 0)}) == Price(1, 0.1 + 0.1)
    assert price(problem, {part.key: (0, 1)}) == Price(0, 0.1 + 0.9)
    assert price(problem, {part.key: (0, 1)}) < price(problem, {part.key: (0, 0)})


def test_a_limit_over_all_robots_counts_every_interface() -> None:
    first, second = block([[0.1], [0.1]], robot="one", capacity=0), block([[0.1]], robot="two", capacity=0)
    problem = Problem((first, second), {CLOUD_0: 2})
    assert fleet_excess(problem, {first.key: (0, 0), second.key: (0,)}) == {CLOUD_0: 1}


def test_validity() -> None:
    shared = block([[0.1, None], [0.2, 0.3]])
    assert is_valid(shared, (0, 1))
    assert not is_valid(shared, (1, 1))
    assert not is_valid(shared, (0, None))
    assert not is_valid(shared, (0,))
    single = block([[0.1, None], [0.2, 0.3]], idempotent=False)
    assert is_valid(single, (0, 0))
    assert is_valid(single, (None, 1))
    assert not is_valid(single, (0, 1))
    assert not is_valid(single, (None, 0))
    assert not is_valid(single, (None, None))


def test_a_plan_tells_what_it_costs_and_what_it_promises() -> None:
    part = block([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]])
    plan = make_plan(Problem((part,)), {part.key: (0, 1, 1)})
    made = plan.blocks[part.key]
    assert made.assignments == (("if0", "cloud-0"), ("if1", "cloud-1"), ("if2", "cloud-1"))
    assert made.cost == pytest.approx(0.1 + 0.4 + 0.6)
    assert made.predicted_miss == pytest.approx(0.1 * 0.4 * 0.6)
    assert made.excess == plan.relaxed == 1


def test_an_interface_without_a_server_is_a_sure_miss_in_the_sum() -> None:
    part = block([[0.1, None], [0.2, 0.3]], idempotent=False)
    made = make_plan(Problem((part,)), {part.key: (None, 1)}).blocks[part.key]
    assert made.assignments == (("if1", "cloud-1"),)
    assert made.cost == pytest.approx(1.3)
    assert made.predicted_miss == pytest.approx(0.3)


def test_an_old_plan_is_read_in_the_new_numbering_or_given_up() -> None:
    part = block([[0.1, 0.2], [0.3, 0.4]])
    plan = make_plan(Problem((part,)), {part.key: (0, 1)}).blocks[part.key]
    assert choice_of(part, plan) == (0, 1)
    assert choice_of(part, None) is None
    assert choice_of(block([[0.1, 0.2], [0.3, None]]), plan) is None
    assert choice_of(block([[0.1], [0.3]]), plan) is None
    assert choice_of(block([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]]), plan) is None


def test_groups_share_no_limit_that_could_bind() -> None:
    one, two, three = (block([[0.1, 0.2]], robot=name) for name in ("one", "two", "three"))
    assert len(independent_groups(Problem((one, two, three)))) == 3
    assert len(independent_groups(Problem((one, two, three), {CLOUD_0: 3}))) == 3
    assert len(independent_groups(Problem((one, two, three), {CLOUD_0: 2}))) == 1
    left = block([[0.1]], robot="left")
    assert len(independent_groups(Problem((left, one, two), {CLOUD_1: 1}))) == 2


def test_groups_that_meet_late_are_joined() -> None:
    ends = [block([[0.1, None]], robot="a"), block([[None, 0.1]], robot="b")]
    first, second = (
        type(part)(part.key, part.interfaces, (part.servers[number],), ((0.1,),)) for number, part in enumerate(ends)
    )
    bridge = block([[0.1, 0.2]], robot="c")
    groups = independent_groups(Problem((first, second, bridge), {CLOUD_0: 1, CLOUD_1: 1}))
    assert len(groups) == 1
    assert {part.key for part in groups[0].blocks} == {first.key, second.key, bridge.key}
    assert len(independent_groups(Problem((first, second), {CLOUD_0: 1, CLOUD_1: 1}))) == 2


def test_grouping_never_changes_the_best_price() -> None:
    rng = random.Random(11)
    for _ in range(60):
        problem = random_problem(rng, max_choices=800)
        groups = independent_groups(problem)
        assert sorted(part.key for group in groups for part in group.blocks) == sorted(
            part.key for part in problem.blocks
        )
        parts = [best_price(group) for group in groups]
        whole = best_price(problem)
        assert sum(part.excess for part in parts) == whole.excess
        assert sum(part.cost for part in parts) == pytest.approx(whole.cost)


def test_greedy_is_always_valid_and_never_better_than_the_best() -> None:
    rng = random.Random(12)
    for _ in range(60):
        problem = random_problem(rng, max_choices=800)
        choices = greedy(problem)
        assert all(is_valid(part, choices[part.key]) for part in problem.blocks)
        reached, best = price(problem, choices), best_price(problem)
        assert (reached.excess, reached.cost + 1e-9) >= (best.excess, best.cost)
