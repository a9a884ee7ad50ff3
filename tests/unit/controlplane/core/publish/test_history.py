"""What is remembered of past mappings."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.controlplane.core.problem.problem import BlockKey
from plr.controlplane.core.publish import history as mapping_history
from plr.controlplane.core.publish.history import MAX_REMEMBERED_CHANGES, MappingHistory
from plr.protos.model.ids import InterfaceName, NodeName, ServiceName, Version
from plr.protos.model.mapping import Assignment, MappingSet, ServiceMapping
from tests.support.samples import PLAN

if TYPE_CHECKING:
    import pytest

ROBOT = NodeName("robot")
KEY = BlockKey(ROBOT, PLAN)


def sent(version: int, server: str, *, reason: str = "", miss: float = 0.1) -> MappingSet:
    mapping = ServiceMapping(PLAN, (Assignment(InterfaceName("wlan0"), NodeName(server)),), miss, reason)
    return MappingSet(Version(version), 1, (mapping,))


def test_a_change_is_remembered_and_mere_news_of_the_prediction_is_not() -> None:
    history = MappingHistory()
    history.note(ROBOT, sent(1, "a"), 10.0)
    history.note(ROBOT, sent(2, "a", miss=0.3), 11.0)
    history.note(ROBOT, sent(3, "b", reason="moved"), 12.0)
    history.note(ROBOT, sent(4, "b", reason="room"), 13.0)
    found = history.of(KEY)
    assert found is not None
    assert [(change.at, change.version) for change in found.changes] == [(13.0, 4), (12.0, 3), (10.0, 1)]
    assert found.since == 12.0
    assert history.of(BlockKey(NodeName("other"), PLAN)) is None


def test_old_changes_and_old_histories_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mapping_history, "MAX_HISTORIES", 2)
    history = MappingHistory()
    for version in range(1, MAX_REMEMBERED_CHANGES + 5):
        history.note(ROBOT, sent(version, f"cloud-{version}"), float(version))
    found = history.of(KEY)
    assert found is not None
    assert len(found.changes) == MAX_REMEMBERED_CHANGES
    history.note(NodeName("second"), sent(1, "a"), 50.0)
    history.note(ROBOT, sent(99, "a"), 51.0)
    history.note(NodeName("third"), sent(1, "a"), 52.0)
    assert history.dropped == 1


def test_a_robot_that_names_ever_new_services_loses_its_own_histories(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mapping_history, "MAX_HISTORIES", 20)
    history = MappingHistory()
    honest = [NodeName(f"honest-{number}") for number in range(10)]
    for name in honest:
        history.note(name, sent(1, "a"), 1.0)
    for number in range(1000):
        mapping = ServiceMapping(ServiceName(f"/service_{number}"), (), 0.1, "")
        history.note(ROBOT, MappingSet(Version(number + 1), 1, (mapping,)), 2.0)
    for name in honest:
        found = history.of(BlockKey(name, PLAN))
        assert found is not None
        assert found.since == 1.0
    assert history.dropped == 1000 - 10
    assert history.of(BlockKey(ROBOT, ServiceName("/service_999"))) is not None
    assert history.of(BlockKey(ROBOT, ServiceName("/service_0"))) is None
