"""What one robot's block does to the solver costs that block, and nobody else's."""

from __future__ import annotations

import itertools
import logging
import math
import random
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.core.estimate.fading import FORGET_S
from plr.controlplane.core.estimate.processing import ComputeTimes
from plr.controlplane.core.problem.problem import Block, BlockKey, FleetKey, Objective, Problem
from plr.controlplane.core.publish.snapshots import VersionSource
from plr.controlplane.solver import group
from plr.controlplane.solver.matcher import Matcher
from plr.protos.convert import use_from_proto, use_to_proto
from plr.protos.model.ids import MAX_VERSION, InterfaceName, NodeName, ServiceName, Version
from plr.protos.model.members import Copies
from tests.support.samples import histogram, use

if TYPE_CHECKING:
    from collections.abc import Mapping

    from plr.controlplane.core.problem.plan import Plan
    from plr.controlplane.core.problem.problem import FleetKey as Key

SERVICE = ServiceName("/plan")


def block(robot: str, interfaces: int = 2, servers: int = 2) -> Block:
    names = tuple(InterfaceName(f"if{number}") for number in range(interfaces))
    clouds = tuple(NodeName(f"cloud-{number}") for number in range(servers))
    epsilon = tuple(tuple(0.01 * (1 + i + j) for j in range(servers)) for i in range(interfaces))
    return Block(BlockKey(NodeName(robot), SERVICE), names, clouds, epsilon, capacity=1)


@pytest.mark.audit("ops-20")
@pytest.mark.parametrize("limited", [False, True])
def test_a_block_that_cannot_be_solved_costs_no_other_its_mapping(
    limited: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    solve = group.GroupSolver.solve

    def fails(self: group.GroupSolver, hint: Plan | None, prices: Mapping[Key, float]) -> group.Found:
        if any(one.key.robot == "bad" for one in self._group.blocks):
            raise IndexError("of nothing")
        return solve(self, hint, prices)

    monkeypatch.setattr(group.GroupSolver, "solve", fails)
    monkeypatch.setattr(group, "_failures", group.FailureLog())
    capacity = {FleetKey(NodeName(f"cloud-{number}"), SERVICE): 3 for number in range(2)} if limited else {}
    problem = Problem((block("good-1"), block("bad"), block("good-2")), capacity)
    matcher = Matcher()
    with caplog.at_level(logging.ERROR):
        for _ in range(3):
            plan = matcher.solve(problem, time_limit_s=10.0)
    for name in ("good-1", "good-2"):
        assert len(plan.blocks[BlockKey(NodeName(name), SERVICE)].assignments) == 2
    assert plan.blocks[BlockKey(NodeName("bad"), SERVICE)].assignments == ((InterfaceName("if0"), NodeName("cloud-0")),)
    assert caplog.text.count("could not be solved") == 1
    assert "bad" in caplog.text


@pytest.mark.audit("ops-20")
@pytest.mark.parametrize("seed", range(3))
def test_fewer_copies_than_interfaces_on_crowded_servers_are_the_best_there_are(
    seed: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Two robots, six interfaces each, three copies each, six servers with room for one: each server is taken once."""
    rng = random.Random(seed)
    shape = block("shape", interfaces=6, servers=6)
    one, other = (
        replace(
            shape,
            key=BlockKey(NodeName(name), SERVICE),
            epsilon=tuple(tuple(rng.random() ** 3 for _ in range(6)) for _ in range(6)),
            copies=Copies(3, 3),
        )
        for name in ("one", "other")
    )
    capacity = {FleetKey(server, SERVICE): 1 for server in one.servers}
    with caplog.at_level(logging.ERROR):
        plan = Matcher().solve(Problem((one, other), capacity, Objective.PRODUCT), time_limit_s=20.0)
    assert not caplog.text
    taken = [server for found in plan.blocks.values() for _, server in found.assignments]
    assert sorted(taken) == sorted(one.servers)
    assert not plan.relaxed
    costs = [_least_of_three(part) for part in (one, other)]
    best = min(costs[0][servers] + costs[1][frozenset(range(6)) - servers] for servers in costs[0])
    assert sum(found.cost for found in plan.blocks.values()) == pytest.approx(best, abs=1e-6)


def _least_of_three(part: Block) -> dict[frozenset[int], float]:
    """By set of three servers the least that three copies to them cost."""
    found: dict[frozenset[int], float] = {}
    for servers in itertools.combinations(range(6), 3):
        found[frozenset(servers)] = min(
            sum(math.log(part.epsilon[i][j] or 0.0) for i, j in zip(interfaces, servers, strict=True))
            for interfaces in itertools.permutations(range(6), 3)
        )
    return found


@pytest.mark.audit("ops-20")
def test_a_robot_may_have_more_interfaces_than_an_array_dimensions() -> None:
    many = replace(block("robot", interfaces=40, servers=1), capacity=40)
    plan = Matcher().solve(Problem((many, block("other"))), time_limit_s=10.0)
    assert len(plan.blocks[BlockKey(NodeName("other"), SERVICE)].assignments) == 2
    assert plan.blocks[many.key].assignments


def test_the_least_wanted_miss_is_one_that_can_be_counted_with() -> None:
    message = use_to_proto(use(target_miss=0.5))
    message.target_miss = 5e-324
    assert use_from_proto(message).target_miss == 1e-9
    message.target_miss = 0.0
    assert use_from_proto(message).target_miss == 0.0


def test_the_largest_version_that_a_sidecar_may_claim_is_not_exceeded() -> None:
    versions = VersionSource(1000)
    assert versions.above(Version(MAX_VERSION)) == MAX_VERSION
    assert versions.above(Version(0)) == 1002, "the others' versions go on as before"


def test_the_first_report_after_a_long_silence_is_like_any_other() -> None:
    times = ComputeTimes(60.0)
    for now in (0.0, FORGET_S + 1.0, 3 * FORGET_S):
        times.merge(NodeName("robot"), NodeName("cloud"), SERVICE, histogram(0.01, times=5), now)
        assert times.times(NodeName("cloud"), SERVICE, now).requests > 0
