"""Which blocks are solved together."""

from __future__ import annotations

import random

import pytest

from plr.controlplane.core.problem.problem import FleetKey, Problem
from plr.controlplane.core.solve.limits import independent_groups
from plr.protos.model.ids import NodeName
from tests.unit.controlplane.problems import PLAN, best_price, block, random_problem

CLOUD_0 = FleetKey(NodeName("cloud-0"), PLAN)
CLOUD_1 = FleetKey(NodeName("cloud-1"), PLAN)


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
