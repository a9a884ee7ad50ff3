"""Patterns of server groups find each block's best choice, and what they say is the least is not above it."""

from __future__ import annotations

import random
from dataclasses import replace
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
import pytest

from plr.controlplane.core.problem.problem import Block, Objective, Problem, block_excess, is_valid
from plr.controlplane.core.solve.enumeration import OWN_EXCESS_PRICE
from plr.controlplane.core.solve.limits import Limits
from plr.controlplane.core.solve.pattern_batch import PatternStack
from plr.protos.model.members import Copies
from tests.unit.controlplane.problems import block, plain_cost, random_problem, valid_choices

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.controlplane.core.problem.problem import Choice


def random_stacks(rng: random.Random, objective: Objective) -> Iterator[list[Block]]:
    """Blocks as a stack holds them, of one to three interfaces."""
    parts = [
        replace(part, target=None)
        for _ in range(60)
        for part in random_problem(rng, objective, ruled=rng.random() < 0.7).blocks
        if part.idempotent
    ]
    parts.sort(key=lambda part: len(part.interfaces))
    for _, alike in groupby(parts, key=lambda part: len(part.interfaces)):
        yield list(alike)


def rank(objective: Objective, part: Block, choice: Choice, prices: list[float], excess_price: float) -> float:
    paid = sum(prices[j] for j in choice if j is not None)
    return plain_cost(objective, part, choice) + paid + excess_price * block_excess(part, choice)


@pytest.mark.parametrize("excess_price", [3.0, OWN_EXCESS_PRICE])
@pytest.mark.parametrize("at_most", [1, 8, 64, 4096])
@pytest.mark.parametrize("objective", Objective)
def test_nothing_is_below_the_least(objective: Objective, at_most: int, excess_price: float) -> None:
    rng = random.Random(51)
    for blocks in random_stacks(rng, objective):
        stack = PatternStack(objective, blocks, Limits(Problem(())), at_most=at_most)
        prices = [rng.choice([0.0, rng.random(), 5.0]) for _ in range(stack.servers)] + [0.0]
        found = stack.best(stack.every, np.tile(prices, (len(blocks), 1)), excess_price)
        for part, value, excess, picks, least in zip(blocks, *found, strict=True):
            choice = stack.choice_of(picks)
            assert is_valid(part, choice)
            assert excess == block_excess(part, choice)
            assert value + excess_price * excess == pytest.approx(rank(objective, part, choice, prices, excess_price))
            best = min(rank(objective, part, choice, prices, excess_price) for choice in valid_choices(part))
            assert least <= best + 1e-6
            # Exact, but where lifts are capped and where groups are too few.
            if at_most == 4096 and excess_price == OWN_EXCESS_PRICE and not any(x > 1 for x in part.lifts.values()):
                assert value + excess_price * excess == pytest.approx(best)
                assert least == pytest.approx(best) or (excess and part.regions)


def test_closed_servers_are_not_taken() -> None:
    rng = random.Random(52)
    for blocks in random_stacks(rng, Objective.JOINT):
        stack = PatternStack(Objective.JOINT, blocks, Limits(Problem(())), at_most=64)
        prices = np.zeros((len(blocks), stack.servers + 1))
        prices[:, 0] = np.inf
        found = stack.best(stack.every, prices)
        for part, value, picks in zip(blocks, found.value, found.picks, strict=True):
            possible = [choice for choice in valid_choices(part) if 0 not in choice]
            assert bool(possible) == bool(np.isfinite(value))
            assert not possible or stack.choice_of(picks) in possible


def test_choices_near_the_best_are_valid_and_worth_what_they_say() -> None:
    rng = random.Random(53)
    for blocks in random_stacks(rng, Objective.JOINT):
        stack = PatternStack(Objective.JOINT, blocks, Limits(Problem(())), at_most=64)
        for row, part in enumerate(blocks):
            prices = [rng.random() for _ in range(stack.servers)] + [0.0]
            near = stack.near(row, np.array(prices), 10.0, 6)
            assert len(near.values) >= 1
            for value, excess, picks in zip(near.values, near.excess, near.picks, strict=True):
                choice = stack.choice_of(picks)
                assert is_valid(part, choice)
                assert excess == block_excess(part, choice)
                assert value == pytest.approx(rank(Objective.JOINT, part, choice, prices, 0.0))


@pytest.mark.audit("ops-20")
@pytest.mark.parametrize("objective", Objective)
def test_there_are_choices_near_the_best_however_few_copies_are_wanted(objective: Objective) -> None:
    rng = random.Random(54)
    for interfaces in (4, 6, 8, 12):
        for least, most in ((1, 1), (2, 3), (3, 3), (1, interfaces), (interfaces, interfaces)):
            epsilon: list[list[float | None]] = [
                [None if rng.random() < 0.2 else rng.random() ** 4 for _ in range(4)] + [0.5] for _ in range(interfaces)
            ]
            part = block(epsilon, copies=Copies(least, most))
            stack = PatternStack(objective, [part], Limits(Problem(())), at_most=4096)
            prices = np.array([rng.random() for _ in range(stack.servers)] + [0.0])
            best = stack.best(stack.every, prices[None])
            for at_most in (1, 4, 100):
                near = stack.near(0, prices, 1.0, at_most)
                assert 1 <= len(near.values) <= at_most
                ranks = near.values + OWN_EXCESS_PRICE * near.excess
                assert ranks[0] <= best.value[0] + OWN_EXCESS_PRICE * best.excess[0] + 1e-9
                assert all(is_valid(part, stack.choice_of(picks)) for picks in near.picks)
