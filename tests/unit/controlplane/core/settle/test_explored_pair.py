"""Which pair a few requests would teach most about."""

from __future__ import annotations

import random
from dataclasses import replace
from statistics import fmean

import pytest

from plr.controlplane.core.problem.plan import BlockPlan, Plan, make_plan
from plr.controlplane.core.problem.problem import Block, Choice, Problem
from plr.controlplane.core.settle.explored_pair import TRIALS, ExploredPairs, knowledge_gradient, most_instructive
from plr.protos.model.ids import InterfaceName, NodeName
from plr.protos.model.mapping import Assignment
from tests.unit.controlplane.problems import block


def known(epsilon: list[list[float | None]], weights: list[list[float]], *, idempotent: bool = True) -> Block:
    return replace(block(epsilon, idempotent=idempotent), weights=tuple(tuple(row) for row in weights))


def planned(part: Block, choice: Choice) -> BlockPlan:
    return make_plan(Problem((part,)), {part.key: choice}).blocks[part.key]


def pair(interface: int, server: int) -> Assignment:
    return Assignment(InterfaceName(f"if{interface}"), NodeName(f"cloud-{server}"))


def explored(part: Block, choice: Choice, before: Assignment | None = None) -> Assignment | None:
    return most_instructive(part, planned(part, choice), before)


def test_an_untried_pair_comes_before_one_known_to_be_bad() -> None:
    part = known([[0.05, 0.5, 0.5]], [[100.0, 20.0, 1.0]])
    assert explored(part, (0,)) == pair(0, 2)


def test_where_all_is_known_nothing_is_worth_a_request() -> None:
    assert explored(known([[0.01, 0.6]], [[100.0, 100.0]]), (0,)) is None


def test_mapped_pairs_and_such_without_a_path_are_not_explored() -> None:
    part = known([[0.2, None], [0.5, 0.2]], [[1.0, 0.0], [1.0, 1.0]])
    assert explored(part, (0, 1)) == pair(1, 0)
    assert explored(known([[0.2, None]], [[1.0, 0.0]]), (0,)) is None


def test_what_may_run_once_only_explores_nothing() -> None:
    part = known([[0.2, 0.5], [0.5, 0.2]], [[1.0, 1.0], [1.0, 1.0]], idempotent=False)
    assert explored(part, (0, 0)) is None


def test_another_pair_has_to_promise_twice_as_much() -> None:
    part = known([[0.2, 0.3, 0.3]], [[100.0, 5.0, 6.0]])
    assert explored(part, (0,)) == pair(0, 1)
    assert explored(part, (0,), pair(0, 2)) == pair(0, 2)
    learnt = known([[0.2, 0.3, 0.6]], [[100.0, 5.0, 30.0]])
    assert explored(learnt, (0,), pair(0, 2)) == pair(0, 1)


@pytest.mark.parametrize(("rival", "mean", "weight"), [(0.2, 0.3, 5.0), (0.4, 0.3, 10.0), (0.1, 0.5, 4.0)])
def test_the_gain_is_what_trials_bring_on_average(rival: float, mean: float, weight: float) -> None:
    rng = random.Random(1)

    def better_by() -> float:
        true = rng.betavariate(mean * weight, (1.0 - mean) * weight)
        misses = sum(rng.random() < true for _ in range(int(TRIALS)))
        learnt = (mean * weight + misses) / (weight + TRIALS)
        return min(rival, mean) - min(rival, learnt)

    simulated = fmean(better_by() for _ in range(20_000))
    assert knowledge_gradient(rival, mean, weight) == pytest.approx(simulated, rel=0.4, abs=0.002)


def test_what_did_not_change_is_not_looked_at_again() -> None:
    part = known([[0.2, 0.5]], [[1.0, 1.0]])
    exploration, plan = ExploredPairs(), Plan({part.key: planned(part, (0,))})
    assert exploration.update(Problem((part,)), plan) == {part.key: pair(0, 1)}
    assert exploration.update(Problem((part,)), plan) == {part.key: pair(0, 1)}
    moved = Plan({part.key: planned(part, (1,))})
    assert exploration.update(Problem((part,)), moved) == {part.key: pair(0, 0)}
    assert exploration.update(Problem(()), Plan({})) == {}
