"""What becomes of a request that the robot has answered itself: for the estimates, the network missed or made it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from plr.protos.model.ids import ServiceName
from plr.sidecar.core.base.values import PathState, RejectReason
from plr.sidecar.core.rules.service_rule import FallbackRule
from plr.sidecar.core.seam.application import DeadlineMissed, ResponseArrived, Unreachable
from tests.support.builders import ECHO, B, request_id
from tests.unit.sidecar.core.request_table import RACE, SERVERS, WLAN_A, WWAN_B, Table


def with_fallback() -> Table:
    table = Table()
    table.rule = replace(table.rule, fallback=FallbackRule(ServiceName("/echo_here")))
    return table


def missed(table: Table) -> dict[str, tuple[int, int]]:
    """(measured, missed) by server."""
    return {one.server: (one.requests, one.missed) for one in table.measurements.take(table.routes, []).latencies}


@pytest.mark.parametrize(("number", "measured"), [(1, {}), (RACE, {"cloud-a": (1, 1), "cloud-b": (1, 1)})])
def test_what_the_network_has_not_answered_by_the_deadline_is_a_miss_and_over(
    number: int, measured: dict[str, tuple[int, int]]
) -> None:
    table = Table()
    table.submit(number)
    table.table.answered_locally(request_id(number), 0.9)
    assert table.table.unanswered == 1
    table.table.handle_timer(1.0)
    assert table.only_failure().outcome == "deadline_missed"
    assert not [event for event in table.events if isinstance(event, DeadlineMissed)]
    assert table.stats.requests[ECHO, "deadline_missed"] == 1
    assert missed(table) == measured
    assert sorted(path for path, _ in table.cancelled()) == [WLAN_A, WWAN_B]
    table.assert_empty()


def test_what_the_network_answers_by_the_deadline_is_no_miss() -> None:
    table = Table()
    table.submit(RACE)
    table.table.answered_locally(request_id(RACE), 0.5)
    table.respond(B, copy=1, number=RACE, now=0.9)
    assert [type(event) for event in table.events] == [ResponseArrived]
    table.table.handle_timer(1.0)
    assert table.stats.requests[ECHO, "ok"] == 1
    assert missed(table)["cloud-b"] == (1, 0)


def test_after_the_deadline_it_is_over_at_once() -> None:
    table = Table()
    table.submit()
    table.table.handle_timer(1.0)
    table.sent()
    table.table.answered_locally(request_id(1), 1.2)
    assert table.only_failure().outcome == "deadline_missed"
    assert len(table.cancelled()) == 2
    table.table.answered_locally(request_id(1), 1.3)
    table.assert_empty()


def test_no_further_copies_are_sent() -> None:
    table = Table()
    table.submit()
    table.table.answered_locally(request_id(1), 0.2)
    table.sent()
    table.change(WLAN_A, PathState.DOWN)
    table.reject(RejectReason.OVERLOADED, B, copy=1)
    table.change(WLAN_A, PathState.UP)
    table.table.handle_timer(0.5)
    assert table.sent() == []


@pytest.mark.parametrize("fallback", [False, True])
def test_that_no_path_is_up_is_told_once_to_those_with_a_fallback(*, fallback: bool) -> None:
    table = with_fallback() if fallback else Table()
    table.submit(1)
    table.change(WLAN_A, PathState.DOWN)
    assert table.events == []
    table.change(WWAN_B, PathState.DOWN)
    table.submit(2)
    told = [Unreachable(request_id(number), ECHO) for number in (1, 2)] if fallback else []
    assert table.events == told
    for known in SERVERS.values():
        table.change(known, PathState.UP)
        table.change(known, PathState.DOWN)
    assert table.events == told
