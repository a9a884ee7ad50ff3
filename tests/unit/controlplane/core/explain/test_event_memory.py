"""Events are bounded, and no member's push out others'."""

from __future__ import annotations

import pytest

from plr.controlplane.core.explain.event_memory import (
    EVENTS_BURST,
    EVENTS_PER_S,
    MAX_EVENTS,
    MAX_REFUSALS,
    PRESENCE_BURST,
    EventMemory,
)
from plr.protos.model.fleet_events import EventKind, FleetEvent
from plr.protos.model.ids import NodeName

pytestmark = pytest.mark.audit("ops-11")


def event(number: int, node: str | None) -> FleetEvent:
    return FleetEvent(number, 0.0, EventKind.CONNECTED, NodeName(node) if node is not None else None)


def test_who_has_most_loses_its_oldest() -> None:
    memory = EventMemory()
    quiet = [event(number, f"robot-{number}") for number in range(1, 101)]
    for one in quiet:
        memory.add(one)
    for number in range(101, 101 + 3 * MAX_EVENTS):
        memory.add(event(number, "flapping"))
    assert len(memory) == MAX_EVENTS
    assert [one for one in memory if one.node != "flapping"] == quiet
    assert memory.last_number == 100 + 3 * MAX_EVENTS
    assert memory.evicted == 100 + 2 * MAX_EVENTS


def test_where_all_have_one_the_oldest_goes() -> None:
    memory = EventMemory()
    for number in range(1, MAX_EVENTS + 2):
        memory.add(event(number, f"robot-{number}"))
    assert [one.number for one in memory][:2] == [2, 3]
    assert len(memory) == MAX_EVENTS


def test_a_member_has_its_share_and_the_control_plane_is_not_counted() -> None:
    memory = EventMemory()
    taken = 0
    for number in range(1, 1001):
        if memory.admits("flapping", 10.0):
            memory.add(event(number, "flapping"))
            taken += 1
        assert memory.admits(None, 10.0)
    assert taken == EVENTS_BURST
    assert sum(memory.admits("flapping", 10.0, presence=True) for _ in range(100)) == PRESENCE_BURST
    assert memory.admits("another", 10.0)
    assert memory.admits("flapping", 10.0 + 1.0 / EVENTS_PER_S)


def test_refusals_push_out_nothing_of_members() -> None:
    memory = EventMemory()
    members = [event(number, f"robot-{number}") for number in range(1, MAX_EVENTS - MAX_REFUSALS + 1)]
    for one in members:
        memory.add(one)
    first = memory.last_number + 1
    for number in range(first, first + 4 * MAX_EVENTS):
        memory.add(FleetEvent(number, 0.0, EventKind.REFUSED, NodeName(f"stranger-{number}")))
    assert [one for one in memory if one.kind is not EventKind.REFUSED] == members
    assert len(memory) == MAX_EVENTS
    assert memory.evicted == 4 * MAX_EVENTS - MAX_REFUSALS


def test_the_name_with_most_refusals_loses_its_oldest() -> None:
    memory = EventMemory()
    memory.add(FleetEvent(1, 0.0, EventKind.REFUSED, NodeName("seldom")))
    for number in range(2, 2 + 2 * MAX_REFUSALS):
        memory.add(FleetEvent(number, 0.0, EventKind.REFUSED, NodeName("often")))
    assert next(iter(memory)).node == "seldom"
    assert len(memory) == MAX_REFUSALS


def test_the_last_ones_come_the_oldest_first() -> None:
    memory = EventMemory()
    for number in range(1, 6):
        memory.add(event(number, "robot"))
    assert [one.number for one in memory.last(2)] == [4, 5]
    assert [one.number for one in memory.last(9)] == [1, 2, 3, 4, 5]


def test_a_stream_that_ends_all_the_time_leaves_room_for_other_events() -> None:
    memory = EventMemory()
    admitted = 0
    for number in range(600):
        memory.admits("flapping", 10.0 * number, presence=True)
        admitted += number % 4 == 0 and memory.admits("flapping", 10.0 * number + 5.0)
    assert admitted == 150
