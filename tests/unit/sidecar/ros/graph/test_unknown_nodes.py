"""Endpoints without a node: asked for after a while, ever more rarely, and forgotten when they are gone."""

from __future__ import annotations

import itertools

from plr.sidecar.ros.cloud.dds_id import participant_of
from plr.sidecar.ros.graph.unknown_nodes import (
    MAX_ENDPOINTS,
    MAX_PARTICIPANTS,
    MAX_PAUSE_S,
    UNKNOWN_FOR_S,
    UnknownNodes,
)
from tests.support.participant_messages import endpoint, participant_info

PLAN, NEGATE = endpoint(7, 3), endpoint(7, 4)
SEVEN = participant_of(PLAN)
OF_SEVEN = participant_info(7, [("/", "planner", [], [PLAN]), ("/arm", "other", [], [NEGATE])])


def scan(unknown: UnknownNodes, now: float, *endpoints: bytes) -> tuple[str | None, ...]:
    unknown.begin_scan()
    names = tuple(unknown.name_of(endpoint, now) for endpoint in endpoints)
    assert unknown.end_scan() == 0
    return names


def test_what_is_unknown_for_a_while_is_asked_for() -> None:
    unknown = UnknownNodes()
    assert unknown.next_due() is None
    assert scan(unknown, 0.0, PLAN, NEGATE) == (None, None)
    assert unknown.next_due() == UNKNOWN_FOR_S
    assert unknown.take_due(UNKNOWN_FOR_S / 2) == frozenset()
    assert unknown.take_due(UNKNOWN_FOR_S) == {SEVEN}
    assert unknown.learn(OF_SEVEN) == {"/planner", "/arm/other"}
    assert scan(unknown, 2.0, PLAN, NEGATE) == ("/planner", "/arm/other")
    assert unknown.next_due() is None
    assert unknown.learn(OF_SEVEN) == frozenset(), "nothing new"


def test_what_rmw_learns_in_time_is_not_asked_for() -> None:
    unknown = UnknownNodes()
    scan(unknown, 0.0, PLAN)
    scan(unknown, 0.3)
    assert unknown.next_due() is None
    assert unknown.take_due(10.0) == frozenset()


def test_a_name_goes_with_its_endpoint() -> None:
    unknown = UnknownNodes()
    scan(unknown, 0.0, PLAN, NEGATE)
    unknown.learn(OF_SEVEN)
    scan(unknown, 1.0, NEGATE)
    assert scan(unknown, 2.0, PLAN, NEGATE) == (None, "/arm/other")
    scan(unknown, 3.0)
    assert scan(unknown, 4.0, NEGATE) == (None,)


def test_who_gives_no_name_is_asked_ever_more_rarely() -> None:
    unknown = UnknownNodes()
    scan(unknown, 0.0, PLAN)
    calls: list[float] = []
    while len(calls) < 12:
        due = unknown.next_due()
        assert due is not None
        assert unknown.take_due(due) == {SEVEN}
        unknown.learn(participant_info(7, [("/", "planner", [PLAN], [NEGATE])]))  # a reader is no writer
        scan(unknown, due, PLAN)
        calls.append(due)
    pauses = [later - earlier for earlier, later in itertools.pairwise(calls)]
    assert pauses == sorted(pauses)
    assert pauses[0] == UNKNOWN_FOR_S
    assert pauses[-1] == MAX_PAUSE_S


def test_calls_are_never_close_together() -> None:
    """Each of them reaches all: who came since is asked by it as well, and who comes right after it waits."""
    unknown = UnknownNodes()
    scan(unknown, 0.0, PLAN)
    scan(unknown, 0.9, PLAN, endpoint(8, 3))
    assert unknown.take_due(1.0) == {SEVEN, participant_of(endpoint(8, 3))}
    for step in range(50):
        newcomer = endpoint(100 + step, 3)
        now = 1.0 + 0.01 * step
        scan(unknown, now, newcomer)
        due = unknown.next_due()
        assert due is not None
        assert due >= 1.0 + UNKNOWN_FOR_S


def test_what_others_say_of_themselves_is_not_kept() -> None:
    unknown = UnknownNodes()
    scan(unknown, 0.0, PLAN)
    assert unknown.learn(participant_info(8, [("/", "liar", [], [PLAN])])) == frozenset()
    assert (
        unknown.learn(participant_info(7, [("/", "planner", [], [endpoint(7, n) for n in range(100, 2000)])])) == set()
    )
    assert scan(unknown, 1.0, PLAN) == (None,)


def test_one_process_does_not_crowd_out_another() -> None:
    unknown = UnknownNodes()
    unknown.begin_scan()
    for number in range(MAX_ENDPOINTS + 5):
        unknown.name_of(endpoint(1, number), 0.0)
    unknown.name_of(PLAN, 0.0)
    assert unknown.end_scan() == 5
    assert SEVEN in unknown.take_due(UNKNOWN_FOR_S)
    unknown.learn(OF_SEVEN)
    assert scan(unknown, 2.0, PLAN) == ("/planner",)


def test_participants_beyond_the_limit_are_reported_and_have_room_later() -> None:
    unknown = UnknownNodes()
    unknown.begin_scan()
    for number in range(MAX_PARTICIPANTS + 3):
        unknown.name_of(endpoint(100 + number, 3), 0.0)
    assert unknown.end_scan() == 3
    scan(unknown, 1.0)  # they are gone
    scan(unknown, 1.0, PLAN)
    assert unknown.take_due(3.0) == {SEVEN}
