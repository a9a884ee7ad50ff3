"""Moves of two blocks that single moves cannot make."""

from __future__ import annotations

import pytest

from plr.controlplane.core.problem.problem import Block, BlockKey, FleetKey, Objective, Problem
from plr.controlplane.core.solve.decomposition import stack_blocks
from plr.controlplane.core.solve.exchange import trade
from plr.controlplane.core.solve.incumbent import Standing
from plr.controlplane.core.solve.limits import Limits
from plr.protos.model.ids import InterfaceName, NodeName
from tests.support.samples import PLAN

SERVERS = tuple(NodeName(name) for name in "abc")


def block(robot: str, *epsilons: float) -> Block:
    return Block(BlockKey(NodeName(robot), PLAN), (InterfaceName("wlan0"),), SERVERS, (epsilons,))


def traded(first: Block, second: Block) -> dict[str, tuple[int | None, ...]]:
    """From the first at server 0 and the second at server 1; each server takes one."""
    problem = Problem((first, second), {FleetKey(server, PLAN): 1 for server in SERVERS}, Objective.SUM)
    limits = Limits(problem)
    stacks = stack_blocks(problem.objective, problem.blocks, limits)
    standing = Standing.of_choices(problem.objective, stacks, limits, {first.key: (0,), second.key: (1,)})
    before = standing.cost
    trade(standing, lambda: False)
    assert standing.excess == 0
    assert standing.cost <= before
    assert standing.load.tolist() == [sum(choice == (j,) for choice in standing.choices().values()) for j in range(3)]
    return {key.robot: choice for key, choice in standing.choices().items()}


@pytest.mark.parametrize(("elsewhere", "after"), [(0.1, (2, 0)), (0.2, (2, 0)), (0.7, (0, 1))])
def test_one_makes_room_where_the_other_gains_more_than_it_loses(elsewhere: float, after: tuple[int, int]) -> None:
    found = traded(block("one", 0.1, 0.9, elsewhere), block("other", 0.01, 0.5, 0.6))
    assert found == {"one": (after[0],), "other": (after[1],)}
