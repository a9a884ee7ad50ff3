"""Which copies go out when, by mode."""

from __future__ import annotations

import dataclasses

import pytest

from plr.protos.model.redundancy_mode import RedundancyMode
from plr.sidecar.core.base.values import PathId, PathState, RejectReason
from plr.sidecar.core.robot.dispatch.dispatcher import SMALL_REQUEST_BYTES
from plr.sidecar.core.robot.request.request import HEDGE_AT, Request
from plr.sidecar.core.rules.budget import Budget
from tests.support.builders import ECHO, WLAN, WWAN, A, B, path, request_id
from tests.unit.sidecar.core.request_table import RACE, WLAN_A, WWAN_B, Table

WWAN_A = path(WWAN, A)
WLAN_B = path(WLAN, B)


def table_with(mode: RedundancyMode, *, idempotent: bool = True, budgets: tuple[Budget, ...] = ()) -> Table:
    """By round-trip time wlan0 to cloud-a is the first choice."""
    table = Table(idempotent=idempotent, budgets=budgets)
    table.rule = dataclasses.replace(table.rule, redundancy=mode)
    table.routes.set_rtt(WLAN_A, 0.01)
    table.routes.set_rtt(WWAN_B, 0.02)
    return table


def learn(table: Table, latency_s: float, requests: int = 19) -> None:
    """The first choice answers so many requests."""
    for number in range(1001, 1001 + requests):
        table.submit(number)
        table.respond(number=number, now=latency_s)
    table.sent()


@pytest.mark.parametrize(
    ("mode", "at_once", "in_trouble"),
    [
        (RedundancyMode.SINGLE, [WLAN_A], []),
        (RedundancyMode.BACKUP, [WLAN_A], [WWAN_B]),
        (RedundancyMode.HEDGE, [WLAN_A], [WWAN_B]),
        (RedundancyMode.REPLICATE, [WLAN_A, WWAN_B], []),
    ],
)
@pytest.mark.parametrize("state", [PathState.UNSTABLE, PathState.DOWN])
def test_copies_at_once_and_when_the_path_fails(
    mode: RedundancyMode, state: PathState, at_once: list[PathId], in_trouble: list[PathId]
) -> None:
    table = table_with(mode)
    table.submit()
    assert table.sent() == at_once
    table.change(WLAN_A, state)
    assert table.sent() == in_trouble


@pytest.mark.parametrize("mode", RedundancyMode)
def test_a_refusal_moves_the_request_on(mode: RedundancyMode) -> None:
    table = table_with(mode)
    table.submit()
    table.reject(RejectReason.OVERLOADED)
    assert table.sent() == [WLAN_A, WWAN_B]


@pytest.mark.parametrize("mode", [RedundancyMode.BACKUP, RedundancyMode.HEDGE])
def test_what_is_in_trouble_already_gets_the_first_path_that_comes_up(mode: RedundancyMode) -> None:
    table = table_with(mode)
    for known in (WLAN_A, WWAN_B):
        table.routes.set_state(known, PathState.UNSTABLE)
    table.submit()
    assert table.sent() == [WLAN_A]
    table.change(WWAN_B, PathState.UP)
    assert table.sent() == [WWAN_B]


@pytest.mark.parametrize("mode", RedundancyMode)
def test_a_lost_request_is_sent_again_elsewhere_if_it_has_a_backup(mode: RedundancyMode) -> None:
    table = table_with(mode)
    table.submit()
    first = next(message for message in table.outbox._messages.values() if message.path == WLAN_A)
    table.sent()
    for _ in range(2):
        table.table.on_copy_lost(first, 0.1)
    assert table.sent() == ([WWAN_B] if mode is RedundancyMode.BACKUP else [])


@pytest.mark.parametrize("mode", [RedundancyMode.SINGLE, RedundancyMode.BACKUP])
def test_one_server_only_unless_idempotent(mode: RedundancyMode) -> None:
    table = table_with(mode, idempotent=False)
    table.routes.set_state(WWAN_A, PathState.UP)
    table.routes.set_rtt(WWAN_A, 0.03)
    table.submit()
    assert table.sent() == [WLAN_A]
    table.change(WLAN_A, PathState.UNSTABLE)
    assert table.sent() == ([WWAN_A] if mode is RedundancyMode.BACKUP else [])


def test_a_server_that_left_is_not_asked_again_over_another_interface() -> None:
    table = table_with(RedundancyMode.BACKUP, idempotent=False)
    table.routes.set_state(WWAN_A, PathState.UP)
    table.routes.set_rtt(WWAN_A, 0.03)
    table.submit()
    table.table.on_peer_gone(A, 0.1)
    assert table.sent() == [WLAN_A]
    assert "may have run" in table.only_failure().reason


def test_the_hedge_waits_for_the_quantile_once_enough_is_known() -> None:
    table = table_with(RedundancyMode.HEDGE)
    learn(table, 0.04, 18)
    table.submit()
    assert table.table.next_timer() == HEDGE_AT * table.rule.deadline_s
    table.respond()
    learn(table, 0.04, 1)
    table.submit(2)
    table.sent()
    table.table.handle_timer(0.039)
    assert table.sent() == []
    table.table.handle_timer(0.1)
    assert table.sent() == [WWAN_B]
    assert table.stats.hedged == {(WWAN, B, ECHO): 1}
    table.respond(B, 1, 2)
    assert table.stats.called_off == {(WLAN, A, ECHO): 1}
    assert [path for path, _ in table.cancelled()] == [WLAN_A]
    table.assert_empty()


def test_a_hedge_is_not_measured_and_its_first_copy_in_races_only() -> None:
    table = table_with(RedundancyMode.HEDGE)
    for number, measured in ((1, {}), (RACE, {A: (1, 0)})):
        table.submit(number)
        table.table.handle_timer(0.5)
        table.respond(B, 1, number, now=0.6)
        table.respond(A, 0, number, now=0.7)
        assert table.latencies() == measured


def test_hedges_that_win_do_not_make_the_next_ones_sooner() -> None:
    """Of a first copy that was called off is known that it took longer, so the quantile can only grow."""
    table = table_with(RedundancyMode.HEDGE)
    learn(table, 0.1, 60)
    for number in range(1, 60):
        table.submit(number)
        table.handle_timers(0.3)
        table.respond(B, 1, number, now=0.35)
    table.submit(500)
    timer = table.table.next_timer()
    assert timer is not None
    assert timer > 0.3


def test_a_pair_that_misses_loses_its_place() -> None:
    table = table_with(RedundancyMode.SINGLE)
    learn(table, 0.1)
    for number in range(1, 3):
        table.submit(number)
        assert table.sent() == [WLAN_A]
        table.handle_timers(1.0)
    table.submit(3)
    assert table.sent() == [WWAN_B]


def test_without_budget_there_are_no_extra_copies_but_always_a_first_one() -> None:
    nothing = Budget("*", extra_load=0.0)
    for mode in RedundancyMode:
        table = table_with(mode, budgets=(nothing,))
        table.submit()
        assert table.sent() == [WLAN_A]
        table.change(WLAN_A, PathState.UNSTABLE)
        assert table.sent() == []
        table.reject(RejectReason.OVERLOADED)
        assert table.sent() == [WWAN_B], "in place of the first one"
        refused = {RedundancyMode.SINGLE: 0, RedundancyMode.BACKUP: 1, RedundancyMode.HEDGE: 1}
        assert sum(table.stats.copies_refused.values()) == refused.get(mode, 2)


def test_extra_copies_and_their_bytes_are_counted() -> None:
    table = table_with(RedundancyMode.REPLICATE)
    table.submit(payload=bytes(1000))
    first, extra = table.stats.copy_bytes[WLAN, ECHO, "first"], table.stats.copy_bytes[WWAN, ECHO, "extra"]
    assert first == extra
    assert 1000 < first < 1200


LARGE = bytes(2 * SMALL_REQUEST_BYTES)
"""The payload of a request that is shared."""


def sharing_table(*, budgets: tuple[Budget, ...] = ()) -> Table:
    """Each interface reaches each server."""
    table = table_with(RedundancyMode.SHARE, budgets=budgets)
    for known, rtt_s in ((WWAN_A, 0.03), (WLAN_B, 0.04)):
        table.routes.set_state(known, PathState.UP)
        table.routes.set_rtt(known, rtt_s)
    return table


def in_flight(table: Table, number: int = 1) -> Request:
    request = table.parts.in_flight.get(request_id(number))
    assert request is not None
    return request


def test_a_shared_request_goes_to_one_server_over_every_mapped_interface_as_one_message() -> None:
    table = sharing_table()
    table.submit(payload=LARGE)
    request = in_flight(table)
    assert table.sent() == [WLAN_A, WWAN_A]
    assert [copy.paths for copy in request.copies] == [(WLAN_A, WWAN_A)]
    assert not request.observed, "it measures neither path"


def test_a_race_of_shared_requests_measures_each_mapped_pair() -> None:
    table = sharing_table()
    table.submit(RACE, LARGE)
    assert table.sent() == [WLAN_A, WWAN_B]
    assert in_flight(table, RACE).observed


def test_shared_requests_stay_with_their_server_though_another_becomes_faster() -> None:
    table = sharing_table()
    table.submit(1, LARGE)
    table.routes.set_rtt(WWAN_B, 0.001)
    table.submit(2, LARGE)
    assert table.sent() == [WLAN_A, WWAN_A] * 2


def test_shared_requests_follow_the_server_that_answers_what_the_other_one_holds() -> None:
    table = sharing_table()
    table.submit(1, LARGE)
    in_flight(table).copies[0].message.end()
    table.handle_timers(HEDGE_AT * table.rule.deadline_s)
    assert table.sent() == [WLAN_A, WWAN_A, WWAN_B]
    table.respond(number=1, copy=1, server=B, now=0.6)
    assert table.sent() == [WLAN_A], "the copy there is called off"
    table.submit(2, LARGE, now=0.7)
    assert table.sent() == [WWAN_B, WLAN_B]


def test_a_shared_request_is_in_trouble_when_all_its_paths_are() -> None:
    table = sharing_table()
    table.submit(payload=LARGE)
    table.change(WLAN_A, PathState.DOWN)
    assert table.sent() == [WLAN_A, WWAN_A]
    table.change(WWAN_A, PathState.UNSTABLE)
    assert table.sent() == [WWAN_B]


def test_an_interface_without_budget_does_not_share() -> None:
    table = sharing_table(budgets=(Budget(WWAN, extra_bytes_a_day=0),))
    table.submit(payload=LARGE)
    assert table.sent() == [WLAN_A]


def test_a_small_request_goes_over_each_mapped_pair_whole() -> None:
    table = sharing_table()
    table.submit(payload=bytes(SMALL_REQUEST_BYTES // 2))
    assert table.sent() == [WLAN_A, WWAN_B]
