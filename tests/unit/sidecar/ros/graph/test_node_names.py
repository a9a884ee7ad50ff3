"""Calls for the names of unknown nodes: when they begin and end, and what becomes of bad answers."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

import pytest

from plr.sidecar.ros.graph import node_names
from plr.sidecar.ros.graph.node_names import CALL_S, POLL_S, NodeNames
from plr.sidecar.ros.graph.unknown_nodes import MAX_ENDPOINTS, UNKNOWN_FOR_S
from plr.sidecar.ros.log_limit import LimitedLog
from plr.sidecar.ros.stats import BridgeStats
from tests.support.participant_messages import endpoint, participant_info

if TYPE_CHECKING:
    from collections.abc import Iterator

PLAN, OTHER = endpoint(7, 3), endpoint(8, 3)
OF_SEVEN = participant_info(7, [("/", "planner", [], [PLAN])])


class Topic:
    """The discovery topic of a domain in which `answers` are given."""

    def __init__(self, _node: Any) -> None:
        self.is_open = False
        self.calls = 0
        self.answers: list[bytes] = []

    def open(self) -> bool:
        self.calls += 1
        self.is_open = True
        return True

    def under_way(self) -> bool:
        return self.is_open

    def take(self) -> Iterator[bytes]:
        while self.answers:
            yield self.answers.pop(0)

    def close(self) -> None:
        self.is_open = False


@pytest.fixture
def stats() -> BridgeStats:
    return BridgeStats()


@pytest.fixture
def names(monkeypatch: pytest.MonkeyPatch, stats: BridgeStats) -> NodeNames:
    monkeypatch.setattr(node_names, "DiscoveryTopic", Topic)
    return NodeNames(None, stats, LimitedLog(logging.getLogger("plr.sidecar")))


def topic_of(names: NodeNames) -> Topic:
    topic = names._topic
    assert isinstance(topic, Topic)
    return topic


def scan(names: NodeNames, now: float, *endpoints: bytes) -> list[str | None]:
    names.begin_scan()
    found = [names.name_of(endpoint, now) for endpoint in endpoints]
    names.end_scan()
    return found


def test_a_call_ends_when_all_have_answered(names: NodeNames, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "plr.sidecar")
    topic = topic_of(names)
    assert names.next_due() is None
    scan(names, 0.0, PLAN)
    assert not names.turn(0.5)
    assert not topic.under_way()
    assert not names.turn(UNKNOWN_FOR_S)
    assert topic.under_way()
    topic.answers = [OF_SEVEN]
    assert not names.turn(UNKNOWN_FOR_S + POLL_S / 2), "it is heard now and then, not in each turn"
    assert names.turn(UNKNOWN_FOR_S + POLL_S)
    assert not topic.under_way()
    assert scan(names, 2.0, PLAN) == ["/planner"]
    assert [record.getMessage().rsplit(": ", 1)[1] for record in caplog.records] == ["/planner"]
    assert names.next_due() is None


def test_a_call_ends_in_its_time(names: NodeNames) -> None:
    topic = topic_of(names)
    scan(names, 0.0, PLAN, OTHER)
    names.turn(1.0)
    topic.answers = [OF_SEVEN]
    assert names.turn(1.1)
    assert topic.under_way()
    assert not names.turn(1.0 + CALL_S)
    assert not topic.under_way()
    due = names.next_due()
    assert due is not None
    names.turn(due)
    assert topic.calls == 2


def test_what_can_not_be_read_is_counted(names: NodeNames, stats: BridgeStats) -> None:
    topic = topic_of(names)
    scan(names, 0.0, PLAN, OTHER)
    names.turn(1.0)
    topic.answers = [OF_SEVEN[:-1], participant_info(8, [("/", "a", [], [])]), b"", participant_info(9, [])]
    assert not names.turn(1.1)
    assert stats.dropped == {"bad_discovery_message": 1}
    assert scan(names, 2.0, PLAN) == [None]


def test_what_there_is_no_room_for_is_counted(names: NodeNames, stats: BridgeStats) -> None:
    scan(names, 0.0, *(endpoint(7, number) for number in range(MAX_ENDPOINTS + 2)))
    assert stats.dropped == {"too_many_unknown_nodes": 2}
