"""What choices cost with failure domains, fewer copies and targets."""

from __future__ import annotations

import random

import numpy as np
import pytest

from plr.controlplane.core.problem.costs import block_cost, choice_costs, without_rules
from plr.controlplane.core.problem.plan import make_plan
from plr.controlplane.core.problem.problem import Block, Choice, Objective, Problem, Target
from plr.controlplane.solver.matcher import solve
from plr.protos.model.members import AT_MOST_EVERY_INTERFACE, Copies
from tests.unit.controlplane.problems import block, plain_cost, random_problem, rank, valid_choices

EVEN = ((1.0, 1.0), (1.0, 1.0))


def best(part: Block, objective: Objective = Objective.JOINT) -> Choice:
    made = solve(Problem((part,), {}, objective), time_limit_s=60.0).blocks[part.key]
    server_of = dict(made.assignments)
    return tuple(part.servers.index(server_of[name]) if name in server_of else None for name in part.interfaces)


@pytest.mark.parametrize("objective", Objective)
def test_costs_follow_the_definition_one_by_one_and_all_at_once(objective: Objective) -> None:
    rng = random.Random(51)
    for _ in range(200):
        for part in random_problem(rng, objective, ruled=True).blocks:
            choices = list(valid_choices(part))
            plain = [plain_cost(objective, part, choice) for choice in choices]
            assert [block_cost(objective, part, choice) for choice in choices] == pytest.approx(plain, abs=1e-7)
            table = np.array([[-1 if server is None else server for server in choice] for choice in choices])
            assert choice_costs(objective, part, table) == pytest.approx(np.array(plain), abs=1e-7)


@pytest.mark.parametrize("objective", Objective)
def test_a_robot_alone_gets_the_choice_that_ranks_first(objective: Objective) -> None:
    """Cost is one number; this is the order it stands for: the target, sharing, charge, misses."""
    rng = random.Random(52)
    for _ in range(250):
        part = random_problem(rng, objective, limited=False, ruled=True).blocks[0]
        if part.target is None and part.capacity:
            continue  # capacities come first there: test_matcher
        least = min(rank(objective, part, choice) for choice in valid_choices(part))
        assert rank(objective, part, best(part, objective)) == pytest.approx(least, abs=1e-6)


def test_two_copies_go_to_two_regions_although_one_is_better() -> None:
    epsilon: list[list[float | None]] = [[0.01, 0.01, 0.3], [0.01, 0.01, 0.3]]
    assert set(best(block(epsilon))) == {0, 1}
    apart = best(block(epsilon, regions=("eu", "eu", "us")))
    assert 2 in apart
    both = block([[0.01, 0.01], [0.01, 0.01]], regions=("eu", "eu"))
    made = make_plan(Problem((both,)), {both.key: (0, 1)}).blocks[both.key]
    assert made.shared == ("region eu",)


def test_the_number_of_copies_wanted_takes_the_best_interfaces_of_different_carriers() -> None:
    epsilon: list[list[float | None]] = [[0.01, 0.01], [0.01, 0.01], [0.1, 0.1]]
    two = Copies(2, 2)
    assert best(block(epsilon, copies=two))[2] is None
    assert best(block(epsilon, copies=two, carriers=("a", "a", "b")))[2] is not None
    assert best(block(epsilon, copies=Copies(9, 9), capacity=0)) == (0, 0, 0)


def test_an_interface_rather_carries_none_than_one_too_many_where_that_is_wanted() -> None:
    part = block([[0.1], [0.2]], copies=AT_MOST_EVERY_INTERFACE)
    assert best(part) == (0, None)
    same_carrier = block([[0.1, 0.1], [0.2, 0.2]], copies=AT_MOST_EVERY_INTERFACE, carriers=("a", "a"))
    assert best(same_carrier)[1] is None


def test_the_cheapest_choice_within_the_target() -> None:
    epsilon: list[list[float | None]] = [[0.05, 0.2], [0.01, 0.2]]
    charges = ((1.0, 0.5), (4.0, 2.0))

    def choice(target: float) -> Choice:
        return best(block(epsilon, copies=AT_MOST_EVERY_INTERFACE, target=Target(target, charges)))

    assert choice(0.3) == (1, None)
    assert choice(0.06) == (0, None)
    assert choice(0.02) == (0, 1)
    assert choice(0.005) == (1, 0)
    assert choice(1e-4) == (1, 0), "none meets it: the most reliable that shares no server"


def test_equally_cheap_choices_are_told_apart_by_what_they_miss() -> None:
    part = block([[0.02, 0.01], [0.03, 0.04]], copies=AT_MOST_EVERY_INTERFACE, target=Target(0.1, EVEN))
    assert best(part) == (1, None)


def test_what_rules_add_is_taken_off_again() -> None:
    assert without_rules(np.array([-20.0, 4000.0 - 20.0, 0.5, 2000.7])) == pytest.approx(
        np.array([-20.0, -20.0, 0.5, 0.7])
    )
