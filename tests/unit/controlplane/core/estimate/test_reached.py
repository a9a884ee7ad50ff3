"""Which robots have reached which servers."""

from __future__ import annotations

import pytest

from plr.controlplane.core.estimate import reached as module
from plr.controlplane.core.estimate.reached import Reached
from plr.protos.model.ids import NodeName

pytestmark = pytest.mark.audit("ops-12")

A, B = NodeName("a"), NodeName("b")


def test_it_is_remembered_by_robot_and_by_server() -> None:
    reached = Reached()
    reached.note(NodeName("robot"), A)
    assert reached.by(NodeName("robot"), A)
    assert not reached.by(NodeName("other"), A)
    assert (reached.witnesses(A), reached.witnesses(B)) == (1, 0)
    reached.note(NodeName("other"), A)
    reached.note(NodeName("robot"), A)
    assert (reached.by(NodeName("robot"), A), reached.witnesses(A)) == (True, 2)
    reached.forget(NodeName("robot"))
    assert (reached.by(NodeName("robot"), A), reached.witnesses(A), len(reached)) == (False, 1, 1)


def test_who_reached_longest_ago_is_forgotten_first_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_REACHED_PAIRS", 2)
    reached = Reached()
    first, second, third = (NodeName(f"robot-{number}") for number in range(3))
    reached.note(first, A)
    reached.note(second, B)
    reached.note(first, A)
    reached.note(third, A)
    assert (len(reached), reached.forgotten) == (2, 1)
    assert reached.by(first, A)
    assert reached.witnesses(B) == 0
