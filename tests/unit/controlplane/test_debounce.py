"""When it is time to solve, and what of a new plan is taken."""

from __future__ import annotations

import random

import pytest

from controlplane.core.debounce import ROUTINE_INTERVAL_S, ROUTINE_TIMES, URGENT_DELAY_S, Change, Debounce, settle
from controlplane.core.plan import Plan, make_plan, price
from controlplane.core.problem import FleetKey, Objective, Problem
from controlplane.matcher import solve
from protos.model import NodeName
from tests.unit.controlplane.problems import PLAN, block, choices_of, random_problem


def solve_at(debounce: Debounce, now: float, duration: float = 0.0) -> None:
    assert debounce.start(now)
    debounce.finished(now + duration)


def test_without_a_change_there_is_nothing_to_solve() -> None:
    debounce = Debounce()
    assert debounce.next_time() is None
    assert not debounce.start(1e9)


def test_a_path_that_dies_is_solved_for_at_once() -> None:
    debounce = Debounce()
    debounce.note(Change.REPORT, 10.0)
    solve_at(debounce, 10.0)
    debounce.note(Change.PATH, 10.1)
    assert debounce.next_time() == pytest.approx(10.1 + URGENT_DELAY_S)
    debounce.note(Change.PATH, 10.12)
    assert not debounce.start(10.1 + URGENT_DELAY_S / 2)
    solve_at(debounce, 10.1 + URGENT_DELAY_S)
    assert debounce.next_time() is None


def test_reports_alone_are_solved_for_once_in_an_interval() -> None:
    debounce = Debounce()
    starts = []
    for step in range(1000):
        now = step * 0.01
        debounce.note(Change.REPORT, now)
        if debounce.start(now):
            starts.append(now)
            debounce.finished(now)
    assert starts == pytest.approx([k * ROUTINE_INTERVAL_S for k in range(10)])


def test_a_large_fleet_is_solved_less_often() -> None:
    debounce = Debounce()
    debounce.note(Change.REPORT, 0.0)
    solve_at(debounce, 0.0, duration=3.0)
    debounce.note(Change.REPORT, 3.0)
    assert debounce.next_time() == ROUTINE_TIMES * 3.0
    debounce.note(Change.MEMBERS, 3.0)
    assert debounce.next_time() == pytest.approx(3.0 + URGENT_DELAY_S)


def test_what_happens_while_solving_is_solved_for_afterwards() -> None:
    debounce = Debounce()
    debounce.note(Change.PATH, 0.0)
    assert debounce.start(URGENT_DELAY_S)
    debounce.note(Change.PATH, 0.1)
    assert debounce.next_time() is None
    assert not debounce.start(5.0)
    debounce.finished(5.0)
    assert debounce.start(5.0)


def running(epsilon: list[list[float | None]], choice: tuple[int, ...], objective: Objective = Objective.SUM) -> Plan:
    part = block(epsilon)
    return make_plan(Problem((part,), objective=objective), {part.key: choice})


def test_a_slightly_better_plan_is_not_worth_a_change() -> None:
    part = block([[0.100, 0.096], [0.100, 0.100]])
    problem = Problem((part,), objective=Objective.SUM)
    old = running([[0.1, 0.2], [0.2, 0.1]], (0, 1))
    new = solve(problem, time_limit_s=60)
    assert new.blocks[part.key].assignments != old.blocks[part.key].assignments
    settled = settle(problem, new, old)
    assert settled.blocks[part.key].assignments == old.blocks[part.key].assignments
    # It is the old choice, but at today's prices.
    assert settled.blocks[part.key].cost == pytest.approx(0.2)


def test_a_clearly_better_plan_is_taken() -> None:
    part = block([[0.30, 0.05], [0.05, 0.30]])
    problem = Problem((part,), objective=Objective.SUM)
    old = running([[0.1, 0.2], [0.2, 0.1]], (0, 1))
    settled = settle(problem, solve(problem, time_limit_s=60), old)
    assert settled.blocks[part.key].assignments == (("if0", "cloud-1"), ("if1", "cloud-0"))


def test_noise_near_zero_changes_nothing() -> None:
    part = block([[0.0010, 0.0002], [0.0002, 0.0010]])
    problem = Problem((part,), objective=Objective.SUM)
    old = running([[0.1, 0.2], [0.2, 0.1]], (0, 1))
    settled = settle(problem, solve(problem, time_limit_s=60), old)
    assert settled.blocks[part.key].assignments == old.blocks[part.key].assignments


@pytest.mark.parametrize("objective", [Objective.PRODUCT, Objective.JOINT])
@pytest.mark.parametrize(
    ("epsilon", "changes"),
    [
        ([[0.30, 0.05], [0.05, 0.30]], True),
        ([[0.100, 0.096], [0.100, 0.100]], False),
        ([[0.0010, 0.0002], [0.0002, 0.0010]], False),
    ],
    ids=["clearly better", "slightly better", "noise near zero"],
)
def test_logarithms_change_for_a_share_and_for_misses_that_count(
    epsilon: list[list[float | None]], changes: bool, objective: Objective
) -> None:
    part = block(epsilon)
    problem = Problem((part,), objective=objective)
    old = running([[0.1, 0.2], [0.2, 0.1]], (0, 1), objective)
    settled = settle(problem, solve(problem, time_limit_s=60), old)
    assert (settled.blocks[part.key].assignments != old.blocks[part.key].assignments) == changes


def test_a_plan_over_a_dead_path_is_replaced_however_little_is_gained() -> None:
    part = block([[None, 0.5], [0.5, 0.5]])
    problem = Problem((part,), objective=Objective.SUM)
    old = running([[0.1, 0.2], [0.2, 0.1]], (0, 1))
    settled = settle(problem, solve(problem, time_limit_s=60), old)
    assert settled.blocks[part.key].assignments == (("if0", "cloud-1"), ("if1", "cloud-0"))


def test_a_plan_that_exceeds_a_capacity_is_replaced_by_one_that_need_not() -> None:
    part = block([[0.1, 0.2], [0.1, 0.2]])
    problem = Problem((part,), objective=Objective.SUM)
    old = running([[0.1, None], [0.1, None]], (0, 0))
    assert old.relaxed == 1
    assert settle(problem, solve(problem, time_limit_s=60), old).relaxed == 0


def test_blocks_without_a_running_plan_get_the_new_one_and_gone_ones_are_dropped() -> None:
    known, fresh = block([[0.1]], robot="known"), block([[0.1]], robot="fresh")
    old = solve(Problem((known, block([[0.1]], robot="gone"))), time_limit_s=60)
    problem = Problem((known, fresh))
    settled = settle(problem, solve(problem, time_limit_s=60), old)
    assert set(settled.blocks) == {known.key, fresh.key}


def test_a_plan_for_another_problem_is_a_mistake() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        settle(Problem((block([[0.1]]),)), Plan({}), None)


@pytest.mark.parametrize("seed", range(5))
def test_settling_never_costs_much_and_never_exceeds_more(seed: int) -> None:
    rng = random.Random(seed)
    running_plan: Plan | None = None
    for _ in range(20):
        problem = random_problem(rng, max_choices=500)
        best = solve(problem, time_limit_s=60)
        settled = settle(problem, best, running_plan)
        choices = choices_of(problem, {key: made.assignments for key, made in settled.blocks.items()})
        reached = price(problem, choices)
        assert reached.excess == best.relaxed == settled.relaxed
        best_cost = sum(made.cost for made in best.blocks.values())
        groups = len(problem.blocks)
        assert reached.cost <= max(best_cost + groups * 0.002, best_cost / 0.9) + 1e-6
        assert all(isinstance(key, FleetKey) for key in settled.fleet_excess)
        running_plan = settled


def test_a_limit_over_all_robots_changes_all_its_blocks_together() -> None:
    one, two = block([[0.1, 0.2]], robot="one"), block([[0.1, 0.2]], robot="two")
    limit = {FleetKey(NodeName("cloud-0"), PLAN): 1}
    old = make_plan(Problem((one, two), limit), {one.key: (0,), two.key: (1,)})
    one_now, two_now = block([[0.5, 0.2]], robot="one"), block([[0.1, 0.9]], robot="two")
    problem = Problem((one_now, two_now), limit)
    settled = settle(problem, solve(problem, time_limit_s=60), old)
    assert settled.blocks[one.key].assignments == (("if0", "cloud-1"),)
    assert settled.blocks[two.key].assignments == (("if0", "cloud-0"),)
    assert settled.relaxed == 0
