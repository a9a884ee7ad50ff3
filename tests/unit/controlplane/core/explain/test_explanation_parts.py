"""An explanation is made in parts: small ones, which together are the whole, whatever happens in between."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.core.control.events import Settings
from plr.controlplane.core.explain import explanation
from plr.controlplane.core.explain.explanation import whole
from plr.protos.convert import explanation_from_proto, explanation_to_proto, pairs_to_proto
from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
from plr.protos.model.mapping import Assignment
from plr.protos.model.report import Report
from plr.protos.plr.v1 import admin_pb2
from tests.support.control_world import SETTLED_S, SimSidecar, World
from tests.support.samples import PLAN, histogram, latency, path

if TYPE_CHECKING:
    from plr.protos.model.explanation import PairExplanation

ROBOT, SERVICE = NodeName("robot"), ServiceName(PLAN)
SERVERS = [f"cloud-{number}" for number in range(5)]
NICS = [f"if{number}" for number in range(12)]
"""More than a mapping considers."""


@pytest.fixture
def world() -> World:
    rng = random.Random(1)
    world = World(Settings(warm_up_s=0.0))
    for server in SERVERS:
        world.cloud(server)
    robot = world.robot("robot", *NICS)
    for _ in range(3):
        pairs = [(nic, server) for nic in NICS for server in SERVERS]
        took = [histogram(*(rng.lognormvariate(-3.5, 1.0) for _ in range(30))) for _ in pairs]
        paths = tuple(path(*pair, rtt=times) for pair, times in zip(pairs, took, strict=True))
        latencies = tuple(latency(*pair, times) for pair, times in zip(pairs, took, strict=True))
        world.say(robot, Report(latencies, paths))
        world.run(SETTLED_S)
    return world


def robot_of(world: World) -> SimSidecar:
    return world.sidecars[ROBOT]


def test_the_encoded_parts_are_the_encoded_whole(world: World) -> None:
    head, pairs = world.core.explain_in_parts(ROBOT, SERVICE, lambda: world.now)
    parts = [explanation_to_proto(head).SerializeToString()]
    parts += (pairs_to_proto((pair,)).SerializeToString() for pair in pairs if pair is not None)
    assert len(parts) == 1 + len(NICS) * len(SERVERS)
    answer = admin_pb2.ExplainResponse.FromString(b"".join(parts))
    assert answer == explanation_to_proto(world.core.explain(ROBOT, SERVICE, world.now))
    assert len(explanation_from_proto(answer).pairs) == len(NICS) * len(SERVERS)


def test_each_step_makes_one_pair_or_none(world: World) -> None:
    _, pairs = world.core.explain_in_parts(ROBOT, SERVICE, lambda: world.now)
    steps = list(pairs)
    made = [pair for pair in steps if pair is not None]
    assert len(made) == len(NICS) * len(SERVERS)
    assert len(steps) > len(made), "intervals take steps of their own"


@pytest.mark.parametrize("most", [3, 20, 50, 1000])
def test_those_in_use_come_first_then_the_best_ones_then_the_others(
    world: World, monkeypatch: pytest.MonkeyPatch, most: int
) -> None:
    monkeypatch.setattr(explanation, "MAX_SHOWN_PAIRS", most)
    found = world.core.explain(ROBOT, SERVICE, world.now)
    every = [Assignment(InterfaceName(nic), NodeName(server)) for nic in NICS for server in SERVERS]

    def rank(pair: PairExplanation) -> tuple[bool, float, int]:
        return not pair.chosen, pair.miss.mean if pair.miss is not None else 2.0, every.index(pair.path)

    assert list(found.pairs) == sorted(found.pairs, key=rank)
    assert len(found.pairs) == min(most, len(every))
    assert found.pairs_left_out == len(every) - len(found.pairs)
    assert found.mapping is not None
    assert {pair.path for pair in found.pairs if pair.chosen} <= set(found.mapping.assignments)
    if most > len(every):
        assert {pair.path for pair in found.pairs} == set(every)


def test_what_happens_in_between_harms_nothing(world: World) -> None:
    parts = head, pairs = world.core.explain_in_parts(ROBOT, SERVICE, lambda: world.now)
    for _ in range(5):
        next(pairs)
    world.leave(robot_of(world))
    world.run(SETTLED_S)
    rest = whole(parts).pairs
    assert head.pairs == ()
    assert len(rest) >= len(NICS) * len(SERVERS) - 5
    gone = world.core.explain(ROBOT, SERVICE, world.now)
    assert gone.gone_s is not None
    assert len(gone.pairs) == len(NICS) * len(SERVERS)
