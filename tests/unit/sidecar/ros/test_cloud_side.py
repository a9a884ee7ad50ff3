"""The cloud's side of ROS without ROS: who is asked, and who gets the room that others leave."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest

from sidecar.core.events import AbandonExecution, ExecutionId
from sidecar.ros.cloud_side import CloudSide
from sidecar.ros.stats import BridgeStats


@pytest.fixture
def side() -> Any:
    """One whose loop and data plane do nothing."""
    made: Any = CloudSide.__new__(CloudSide)
    made._stats = BridgeStats()
    made._executions = {}
    made._paced = set()
    return made


@pytest.mark.audit("dp-15")
def test_a_dead_server_beside_a_living_one_keeps_nothing_from_it(side: Any) -> None:
    """A container that was started anew: DDS shows its dead self for 20 s more."""
    side._processes = SimpleNamespace(watches=lambda _endpoint: False, has_ended=lambda _endpoint: False)
    silent = {b"old"}
    side._roll_call = SimpleNamespace(
        has_heard=lambda endpoint, _since: endpoint not in silent, is_silent=lambda endpoint: endpoint in silent
    )
    runner: Any = SimpleNamespace(server=SimpleNamespace(endpoints=frozenset((b"old", b"new")), living=1))
    assert side._is_alive_since(runner, 1.0)
    silent.add(b"new")
    runner.server.living = 0
    assert not side._is_alive_since(runner, 1.0)


@pytest.mark.audit("dp-3")
def test_what_is_given_up_makes_room_for_those_that_wait(side: Any) -> None:
    """The server was full and silent, so nothing was due; what its requests leave free is."""
    runner = Mock()
    runner.name = "/plan"
    execution = ExecutionId(1)
    side._executions[execution] = (runner, SimpleNamespace(id=execution, number=1))
    side._abandon(AbandonExecution(execution, awaited=False))
    assert side._paced == {runner}
