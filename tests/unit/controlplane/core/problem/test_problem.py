"""Limits over all robots, and which choices are valid."""

from __future__ import annotations

from plr.controlplane.core.problem.problem import FleetKey, Problem, fleet_excess, is_valid
from plr.protos.model.ids import NodeName
from tests.unit.controlplane.problems import PLAN, block

CLOUD_0 = FleetKey(NodeName("cloud-0"), PLAN)


def test_a_limit_over_all_robots_counts_every_interface() -> None:
    first, second = block([[0.1], [0.1]], robot="one", capacity=0), block([[0.1]], robot="two", capacity=0)
    problem = Problem((first, second), {CLOUD_0: 2})
    assert fleet_excess(problem, {first.key: (0, 0), second.key: (0,)}) == {CLOUD_0: 1}


def test_validity() -> None:
    shared = block([[0.1, None], [0.2, 0.3]])
    assert is_valid(shared, (0, 1))
    assert not is_valid(shared, (1, 1))
    assert not is_valid(shared, (0, None))
    assert not is_valid(shared, (0,))
    single = block([[0.1, None], [0.2, 0.3]], idempotent=False)
    assert is_valid(single, (0, 0))
    assert is_valid(single, (None, 1))
    assert not is_valid(single, (0, 1))
    assert not is_valid(single, (None, 0))
    assert not is_valid(single, (None, None))
