"""What becomes of the other copies once one is answered, and which copies are measured."""

from __future__ import annotations

import pytest

from plr.sidecar.core.base.request_id import OBSERVED_ONE_IN
from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.robot.dispatch.cancelling import MAX_CALLED_OFF, SMALL_ANSWER_BYTES
from tests.support.builders import ECHO, WLAN, WWAN, A, B, path, request_id
from tests.unit.sidecar.core.request_table import RACE, WLAN_A, WWAN_B, Table


def test_in_a_race_the_loser_is_called_off_at_the_deadline_and_counts_once() -> None:
    table = Table()
    table.submit(RACE)
    table.respond(A, copy=0, number=RACE)
    assert len(table.table._requests) == 1
    table.table.handle_timer(1.0)
    assert table.cancelled() == [(WWAN_B, request_id(RACE))]
    table.assert_empty()
    table.respond(B, copy=1, number=RACE, now=1.2)
    assert table.stats.duplicate_responses == 1
    latencies = {report.server: report for report in table.measurements.take(table.routes, []).latencies}
    assert latencies[B].called_off.quantile(1.0) == pytest.approx(1.0, rel=0.02)
    assert latencies[B].network.total == 0


def test_the_first_response_calls_the_other_copies_off() -> None:
    table = Table()
    table.submit()
    table.respond(B, copy=1)
    assert table.cancelled() == [(WLAN_A, request_id(1))]
    assert table.stats.called_off == {(WLAN, A, ECHO): 1}
    table.assert_empty()
    table.respond(A, copy=0)
    assert table.stats.duplicate_responses == 1
    assert not table.stats.dropped
    assert table.latencies() == {}, "to measure the winner alone would flatter its path"


def test_common_misses_are_counted_at_the_deadline_and_once() -> None:
    table = Table()

    def joints() -> list[tuple[int, int]]:
        return [(joint.requests, joint.both_missed) for joint in table.measurements.take(table.routes, []).joints]

    table.submit(1)
    table.respond(A, copy=0)
    assert joints() == [(1, 0)], "settled before its deadline"
    table.submit(2)
    assert joints() == []
    table.table.handle_timer(1.0)
    assert joints() == [(1, 1)]
    table.respond(B, copy=1, number=2, now=1.5)
    table.table.handle_timer(10.0)
    table.submit(RACE, now=20.0)
    table.respond(A, copy=0, number=RACE, now=20.1)
    assert joints() == [], "the other copy of a race is awaited, and late answers change nothing"
    table.table.handle_timer(21.0)
    assert joints() == [(1, 0)]


def test_a_cancel_takes_the_best_path_to_its_server_and_none_when_there_is_none() -> None:
    table = Table()
    other = path(WWAN, A)
    table.submit()
    table.routes.set_state(other, PathState.UP)
    table.routes.set_state(WLAN_A, PathState.UNSTABLE)
    table.respond(B, copy=1)
    assert table.cancelled() == [(other, request_id(1))]
    table.submit(2)
    for down in (WLAN_A, other):
        table.routes.set_state(down, PathState.DOWN)
    table.respond(B, copy=1, number=2)
    assert table.cancelled() == []


def test_a_server_that_got_nothing_is_told_nothing() -> None:
    table = Table()
    table.submit(begun=False)
    table.respond(B, copy=1)
    assert table.cancelled() == []
    assert table.stats.called_off == {(WLAN, A, ECHO): 1}
    table.assert_empty()


def test_all_copies_at_one_server_are_called_off_with_one_cancel() -> None:
    """It has run already where it won: what the cancel saves is the second answer."""
    table = Table(idempotent=False)
    table.routes.set_state(WWAN_B, PathState.DOWN)
    table.routes.set_state(path(WWAN, A), PathState.UP)
    table.submit()
    assert table.sent() == [WLAN_A, path(WWAN, A)]
    table.respond(A, copy=0, size=SMALL_ANSWER_BYTES + 1)
    assert table.cancelled() == [(WLAN_A, request_id(1))]
    assert table.stats.called_off == {(WWAN, A, ECHO): 1}
    table.assert_empty()


def test_a_server_whose_answer_was_small_is_not_told_to_spare_the_same_answer() -> None:
    table = Table()
    table.routes.set_state(WWAN_B, PathState.DOWN)
    table.routes.set_state(path(WWAN, A), PathState.UP)
    table.submit()
    assert table.sent() == [WLAN_A, path(WWAN, A)]
    table.respond(A, copy=0, size=SMALL_ANSWER_BYTES)
    assert table.cancelled() == []
    assert table.stats.called_off == {(WWAN, A, ECHO): 1}
    table.respond(A, copy=1)
    assert table.stats.duplicate_responses == 1
    table.assert_empty()


def test_a_single_copy_is_always_measured() -> None:
    table = Table()
    table.routes.set_state(WWAN_B, PathState.DOWN)
    table.submit()
    table.respond(A, copy=0)
    assert table.latencies() == {A: (1, 0)}
    assert table.cancelled() == []


def test_a_request_is_measured_with_all_its_copies_or_not_at_all() -> None:
    table = Table()
    for number in range(1, 65):
        table.submit(number)
        table.respond(A, copy=0, number=number)
        if number % 2:
            table.respond(B, copy=1, number=number, now=0.2)
    for now in (1.0, 10.0):
        table.handle_timers(now)
    races = 64 // OBSERVED_ONE_IN
    assert table.latencies() == {A: (races, 0), B: (0, races)}, "all races have even numbers"
    table.cancelled()
    table.assert_empty()


def test_ids_of_what_was_called_off_are_kept_for_a_while_only() -> None:
    table = Table()
    for number in range(1, 2 * MAX_CALLED_OFF):
        table.submit(number)
        table.respond(A, number=number)
    assert len(table.table._calling_off) == MAX_CALLED_OFF
