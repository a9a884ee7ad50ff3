"""What a plan says, costs and promises."""

from __future__ import annotations

import math

import pytest

from plr.controlplane.core.problem.costs import RULE_PRICE
from plr.controlplane.core.problem.plan import Plan, PlanCost, choice_of, make_plan, price, relative_gap, size
from plr.controlplane.core.problem.problem import Objective, Problem
from tests.unit.controlplane.problems import block


def test_price_puts_capacity_before_misses() -> None:
    part = block([[0.1, 0.9], [0.1, 0.9]])
    problem = Problem((part,), objective=Objective.SUM)
    assert price(problem, {part.key: (0, 0)}) == PlanCost(1, 0.1 + 0.1)
    assert price(problem, {part.key: (0, 1)}) == PlanCost(0, 0.1 + 0.9)
    assert price(problem, {part.key: (0, 1)}) < price(problem, {part.key: (0, 0)})


def test_a_plan_tells_what_it_costs_and_what_it_promises() -> None:
    part = block([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]])
    plan = make_plan(Problem((part,), objective=Objective.SUM), {part.key: (0, 1, 1)})
    made = plan.blocks[part.key]
    assert made.assignments == (("if0", "cloud-0"), ("if1", "cloud-1"), ("if2", "cloud-1"))
    assert made.cost == pytest.approx(0.1 + 0.4 + 0.6)
    assert made.predicted_miss == pytest.approx(0.1 * 0.4 * 0.6)
    assert made.excess == plan.relaxed == 1


def test_an_interface_without_a_server_is_a_sure_miss_in_the_sum() -> None:
    part = block([[0.1, None], [0.2, 0.3]], idempotent=False)
    made = make_plan(Problem((part,), objective=Objective.SUM), {part.key: (None, 1)}).blocks[part.key]
    assert made.assignments == (("if1", "cloud-1"),)
    assert made.cost == pytest.approx(1.3)
    assert made.predicted_miss == pytest.approx(0.3)


def test_an_old_plan_is_read_in_the_new_numbering_or_given_up() -> None:
    part = block([[0.1, 0.2], [0.3, 0.4]])
    plan = make_plan(Problem((part,), objective=Objective.SUM), {part.key: (0, 1)}).blocks[part.key]
    assert choice_of(part, plan) == (0, 1)
    assert choice_of(part, None) is None
    assert choice_of(block([[0.1, 0.2], [0.3, None]]), plan) is None
    assert choice_of(block([[0.1], [0.3]]), plan) is None
    assert choice_of(block([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]]), plan) is None


def test_the_gap_is_a_share_of_what_the_costs_come_to_without_rules() -> None:
    assert relative_gap(1.1, 1.0, 1.0) == pytest.approx(0.1)
    assert relative_gap(-90.0, -100.0, 100.0) == pytest.approx(0.1)
    assert relative_gap(0.9999999, 1.0, 1.0) == 0.0
    assert relative_gap(5.0, 0.0, 0.0) == 1.0
    assert relative_gap(0.0, -math.inf, 1.0) == 1.0
    assert size([-10.0, 2.0, 3 * RULE_PRICE - 8.0]) == pytest.approx(20.0)
    assert Plan({}).gap == 0.0
