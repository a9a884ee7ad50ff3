"""What of a new plan is taken."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest

from plr.controlplane.core.problem.plan import Plan, make_plan, price
from plr.controlplane.core.problem.problem import FleetKey, Objective, Problem, Target
from plr.controlplane.core.settle.stability import CHANGE_WINDOW_S, MAX_MOVES, Stability
from plr.controlplane.solver.matcher import solve
from plr.protos.model.ids import NodeName
from plr.protos.model.members import AT_MOST_EVERY_INTERFACE
from tests.unit.controlplane.problems import PLAN, block, choices_of, random_problem


def settled_of(problem: Problem, new: Plan, old: Plan) -> Plan:
    return Stability().settle(problem, new, old, 0.0)


def running(epsilon: list[list[float | None]], choice: tuple[int, ...], objective: Objective = Objective.SUM) -> Plan:
    part = block(epsilon)
    return make_plan(Problem((part,), objective=objective), {part.key: choice})


def test_a_slightly_better_plan_is_not_worth_a_change() -> None:
    part = block([[0.100, 0.096], [0.100, 0.100]])
    problem = Problem((part,), objective=Objective.SUM)
    old = running([[0.1, 0.2], [0.2, 0.1]], (0, 1))
    new = solve(problem, time_limit_s=60)
    assert new.blocks[part.key].assignments != old.blocks[part.key].assignments
    settled = settled_of(problem, new, old)
    assert settled.blocks[part.key].assignments == old.blocks[part.key].assignments
    # It is the old choice, but at today's prices.
    assert settled.blocks[part.key].cost == pytest.approx(0.2)


def test_a_clearly_better_plan_is_taken() -> None:
    part = block([[0.30, 0.05], [0.05, 0.30]])
    problem = Problem((part,), objective=Objective.SUM)
    old = running([[0.1, 0.2], [0.2, 0.1]], (0, 1))
    settled = settled_of(problem, solve(problem, time_limit_s=60), old)
    assert settled.blocks[part.key].assignments == (("if0", "cloud-1"), ("if1", "cloud-0"))


def test_noise_near_zero_changes_nothing() -> None:
    part = block([[0.0010, 0.0002], [0.0002, 0.0010]])
    problem = Problem((part,), objective=Objective.SUM)
    old = running([[0.1, 0.2], [0.2, 0.1]], (0, 1))
    settled = settled_of(problem, solve(problem, time_limit_s=60), old)
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
    settled = settled_of(problem, solve(problem, time_limit_s=60), old)
    assert (settled.blocks[part.key].assignments != old.blocks[part.key].assignments) == changes


@pytest.mark.parametrize(("requests", "changes"), [(2.0, False), (200.0, True)])
def test_what_is_hardly_known_to_be_better_is_not_taken_yet(requests: float, changes: bool) -> None:
    part = replace(block([[0.30, 0.25]]), weights=((200.0, requests),))
    problem = Problem((part,))
    settled = settled_of(problem, make_plan(problem, {part.key: (1,)}), make_plan(problem, {part.key: (0,)}))
    assert (settled.blocks[part.key].assignments == (("if0", "cloud-1"),)) == changes


def test_a_path_that_got_bad_is_left_though_rare_misses_make_the_good_one_uncertain() -> None:
    part = replace(block([[0.2, 0.005]]), weights=((10.0, 10.0),))
    problem = Problem((part,))
    settled = settled_of(problem, make_plan(problem, {part.key: (1,)}), make_plan(problem, {part.key: (0,)}))
    assert settled.blocks[part.key].assignments == (("if0", "cloud-1"),)


@pytest.mark.parametrize(
    ("old", "changes"), [((0, 1), False), ((0, 0), True)], ids=["interfaces fail together", "perhaps the server did"]
)
def test_a_change_wins_nothing_by_leaving_a_lift_that_the_interfaces_keep(old: tuple[int, int], changes: bool) -> None:
    part = replace(block([[0.2, 0.2], [0.2, 0.2]]), lifts={((0, old[0]), (1, old[1])): 4.0})
    problem = Problem((part,), objective=Objective.JOINT)
    new = make_plan(problem, {part.key: (1, 0)})
    settled = settled_of(problem, new, make_plan(problem, {part.key: old}))
    assert (settled.blocks[part.key].assignments == new.blocks[part.key].assignments) == changes


def test_a_plan_over_a_dead_path_is_replaced_however_little_is_gained() -> None:
    part = block([[None, 0.5], [0.5, 0.5]])
    problem = Problem((part,), objective=Objective.SUM)
    old = running([[0.1, 0.2], [0.2, 0.1]], (0, 1))
    settled = settled_of(problem, solve(problem, time_limit_s=60), old)
    assert settled.blocks[part.key].assignments == (("if0", "cloud-1"), ("if1", "cloud-0"))


def test_a_plan_that_exceeds_a_capacity_is_replaced_by_one_that_need_not() -> None:
    part = block([[0.1, 0.2], [0.1, 0.2]])
    problem = Problem((part,), objective=Objective.SUM)
    old = running([[0.1, None], [0.1, None]], (0, 0))
    assert old.relaxed == 1
    assert settled_of(problem, solve(problem, time_limit_s=60), old).relaxed == 0


def test_blocks_without_a_running_plan_get_the_new_one_and_gone_ones_are_dropped() -> None:
    known, fresh = block([[0.1]], robot="known"), block([[0.1]], robot="fresh")
    old = solve(Problem((known, block([[0.1]], robot="gone"))), time_limit_s=60)
    problem = Problem((known, fresh))
    settled = settled_of(problem, solve(problem, time_limit_s=60), old)
    assert set(settled.blocks) == {known.key, fresh.key}


def test_a_plan_for_another_problem_is_a_mistake() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        settled_of(Problem((block([[0.1]]),)), Plan({}), Plan({}))


@pytest.mark.parametrize("seed", range(5))
def test_settling_never_costs_much_and_never_exceeds_more(seed: int) -> None:
    rng = random.Random(seed)
    running_plan = Plan({})
    for _ in range(20):
        problem = random_problem(rng, max_choices=500)
        best = solve(problem, time_limit_s=60)
        settled = settled_of(problem, best, running_plan)
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
    settled = settled_of(problem, solve(problem, time_limit_s=60), old)
    assert settled.blocks[one.key].assignments == (("if0", "cloud-1"),)
    assert settled.blocks[two.key].assignments == (("if0", "cloud-0"),)
    assert settled.relaxed == 0


def test_of_two_changes_that_need_nothing_of_each_other_only_the_good_one_is_made() -> None:
    before: list[list[float | None]] = [[0.1, 0.2]]
    one, two = block(before, robot="one"), block(before, robot="two")
    limit = {FleetKey(NodeName("cloud-0"), PLAN): 2, FleetKey(NodeName("cloud-1"), PLAN): 2}
    old = make_plan(Problem((one, two), limit), {one.key: (0,), two.key: (0,)})
    much, little = block([[0.5, 0.2]], robot="one"), block([[0.20, 0.19]], robot="two")
    problem = Problem((much, little), limit)
    settled = settled_of(problem, make_plan(problem, {one.key: (1,), two.key: (1,)}), old)
    assert settled.blocks[one.key].assignments == (("if0", "cloud-1"),)
    assert settled.blocks[two.key].assignments == (("if0", "cloud-0"),)


def test_a_dead_path_moves_no_robot_that_is_not_in_the_way() -> None:
    alive, dying = block([[0.20, 0.19]], robot="alive"), block([[0.1, 0.2]], robot="dying")
    limit = {FleetKey(NodeName("cloud-0"), PLAN): 1, FleetKey(NodeName("cloud-1"), PLAN): 2}
    old = make_plan(Problem((alive, dying), limit), {alive.key: (1,), dying.key: (0,)})
    problem = Problem((alive, block([[None, 0.2]], robot="dying")), limit)
    settled = settled_of(problem, make_plan(problem, {alive.key: (0,), dying.key: (1,)}), old)
    assert settled.blocks[alive.key].assignments == (("if0", "cloud-1"),)
    assert settled.blocks[dying.key].assignments == (("if0", "cloud-1"),)
    assert settled.blocks[dying.key].why == "moved because if0 to cloud-0 is down"
    assert settled.blocks[alive.key].why == ""


def test_a_robot_moves_to_something_better_only_so_often_in_a_minute() -> None:
    stability = Stability()
    sides = [block([[0.01, 0.5]]), block([[0.5, 0.01]])]
    plan = solve(Problem((sides[1],)), time_limit_s=60)
    moves = []
    for second in range(300):
        problem = Problem((sides[second % 2],))
        settled = stability.settle(problem, solve(problem, time_limit_s=60), plan, float(second))
        if settled.blocks[sides[0].key].assignments != plan.blocks[sides[0].key].assignments:
            moves.append(second)
        plan = settled
    assert moves[:MAX_MOVES] == list(range(MAX_MOVES))
    for start in moves:
        assert sum(start <= move < start + CHANGE_WINDOW_S for move in moves) <= MAX_MOVES
    assert len(moves) == MAX_MOVES * 5


def test_no_number_of_changes_keeps_a_robot_where_all_copies_miss() -> None:
    stability = Stability()
    sides = [block([[0.01, 0.9]]), block([[0.9, 0.01]])]
    plan = Plan({})
    for second in range(20):
        problem = Problem((sides[second % 2],))
        plan = stability.settle(problem, solve(problem, time_limit_s=60), plan, float(second))
        assert plan.blocks[sides[0].key].assignments == (("if0", f"cloud-{second % 2}"),)


def test_a_path_that_dies_is_left_however_often_that_happens() -> None:
    stability = Stability()
    sides = [block([[0.1, None]]), block([[None, 0.1]])]
    plan = Plan({})
    for second in range(40):
        problem = Problem((sides[second % 2],))
        plan = stability.settle(problem, solve(problem, time_limit_s=60), plan, float(second))
        assert plan.blocks[sides[0].key].assignments == (("if0", f"cloud-{second % 2}"),)


def test_every_change_says_why_until_the_next_one() -> None:
    limit = {FleetKey(NodeName("cloud-0"), PLAN): 1}
    one, two = block([[0.1, 0.2]], robot="one"), block([[0.9, 0.2]], robot="two")
    problem = Problem((one, two), limit)
    stability = Stability()
    plan = stability.settle(problem, make_plan(problem, {one.key: (0,), two.key: (1,)}), Plan({}), 0.0)
    assert {made.why for made in plan.blocks.values()} == {""}
    later = Problem((one, block([[0.001, 0.9]], robot="two")), limit)
    better = make_plan(later, {one.key: (1,), two.key: (0,)})
    for now in (1.0, 2.0):
        plan = stability.settle(later, better, plan, now)
        assert plan.blocks[two.key].why == "moved because all copies would have missed with probability 0.9, now 0.001"
        assert plan.blocks[one.key].why == (
            "moved, although it gains nothing, because another service gains more from the server that it leaves"
        )


@pytest.mark.parametrize(
    ("servers", "epsilon", "chosen", "why"),
    [
        (("cloud-1",), [[0.2], [0.2]], (0, 0), "cloud-0 left, or no longer offers the service to this robot"),
        (("cloud-0", "cloud-1"), [[None, 0.2], [0.1, 0.1]], (1, 0), "if0 to cloud-0 is down"),
        (("cloud-0", "cloud-1"), [[0.1, 0.2]] * 3, (0, 1, 0), "if2 can carry requests now"),
    ],
)
def test_a_choice_that_is_no_longer_valid_says_what_came_or_went(
    servers: tuple[str, ...], epsilon: list[list[float | None]], chosen: tuple[int, ...], why: str
) -> None:
    before = block([[0.1, 0.2], [0.2, 0.1]])
    old = make_plan(Problem((before,)), {before.key: (0, 1)})
    after = replace(block(epsilon), servers=tuple(map(NodeName, servers)))
    problem = Problem((after,))
    settled = settled_of(problem, make_plan(problem, {after.key: chosen}), old)
    assert settled.blocks[after.key].why == f"moved because {why}"


def test_the_only_interface_in_use_that_goes_dark_is_named() -> None:
    target = Target(0.5, ((1.0, 1.0), (1.0, 1.0)))
    before = block([[0.1, 0.2], [0.2, 0.1]], copies=AT_MOST_EVERY_INTERFACE, target=target)
    old = make_plan(Problem((before,)), {before.key: (None, 1)})
    after = block([[0.1, 0.2]], copies=AT_MOST_EVERY_INTERFACE, target=Target(0.5, ((1.0, 1.0),)))
    problem = Problem((after,))
    settled = settled_of(problem, make_plan(problem, {after.key: (0,)}), old)
    assert settled.blocks[after.key].why == "moved because no path over if1 is up any more"


def test_a_change_that_exceeds_more_is_never_made() -> None:
    part = block([[0.9, 0.1], [0.1, 0.01]])
    problem = Problem((part,))
    old = make_plan(problem, {part.key: (0, 1)})
    crowded = make_plan(problem, {part.key: (1, 1)})
    assert settled_of(problem, crowded, old).blocks[part.key].assignments == old.blocks[part.key].assignments


@pytest.mark.parametrize(
    ("misses", "weight", "copies", "changes"),
    [
        (0.05, 1000.0, 1, False),
        (0.2, 1000.0, 1, True),
        (0.12, 20.0, 1, False),
        (0.05, 1000.0, 2, True),
        (0.095, 20.0, 2, False),
        (0.2, 1000.0, 2, False),
    ],
)
def test_copies_come_and_go_when_the_target_is_surely_missed_or_surely_met(
    misses: float, weight: float, copies: int, changes: bool
) -> None:
    target = Target(0.1, ((1.0, 1.0), (1.0, 1.0)))
    part = block([[misses, misses], [0.5, 0.5]], copies=AT_MOST_EVERY_INTERFACE, target=target)
    part = replace(part, weights=((weight,) * 2,) * 2)
    problem = Problem((part,))
    old = make_plan(problem, {part.key: (0, None) if copies == 1 else (0, 1)})
    settled = settled_of(problem, solve(problem, time_limit_s=60), old)
    assert len(settled.blocks[part.key].assignments) == (3 - copies if changes else copies)
    if copies == 2 and changes:
        assert settled.blocks[part.key].why == "moved because a request cost 2, now 1"


def test_a_shared_region_is_left_although_that_misses_more() -> None:
    part = block([[0.01, 0.01, 0.02], [0.01, 0.01, 0.02]], regions=("eu", "eu", "us"))
    problem = Problem((part,))
    old = make_plan(problem, {part.key: (0, 1)})
    settled = settled_of(problem, solve(problem, time_limit_s=60), old)
    assert settled.blocks[part.key].shared == ()
    assert settled.blocks[part.key].why.startswith("moved so that its copies share less")
