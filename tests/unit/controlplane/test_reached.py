"""Which robots have reached which servers."""

from __future__ import annotations

import pytest

from controlplane.core import reached as module
from controlplane.core.reached import Reached
from protos.model import NodeName

pytestmark = pytest.mark.audit("ops-12")

A, B = NodeName("a"), NodeName("b")


def test_it_is_remembered_by_robot_and_by_server() -> None:
    reached = Reached()
    reached.note(NodeName("robot"), A, 7.0)
    assert reached.by(NodeName("robot"), A) == 7.0
    assert reached.by(NodeName("other"), A) is None
    assert (reached.witnesses(A), reached.witnesses(B)) == (1, 0)
    reached.note(NodeName("other"), A, 8.0)
    reached.note(NodeName("robot"), A, 9.0)
    assert (reached.by(NodeName("robot"), A), reached.witnesses(A)) == (9.0, 2)
    reached.forget(NodeName("robot"))
    assert (reached.by(NodeName("robot"), A), reached.witnesses(A), len(reached)) == (None, 1, 1)


def test_who_reached_longest_ago_is_forgotten_first_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_PAIRS", 2)
    reached = Reached()
    first, second, third = (NodeName(f"robot-{number}") for number in range(3))
    reached.note(first, A, 1.0)
    reached.note(second, B, 1.0)
    reached.note(first, A, 1.0)
    reached.note(third, A, 1.0)
    assert (len(reached), reached.forgotten) == (2, 1)
    assert reached.by(first, A) is not None
    assert reached.witnesses(B) == 0
