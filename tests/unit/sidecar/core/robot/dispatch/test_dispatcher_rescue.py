"""Requests in trouble: paths that go, servers that refuse or leave, and who else is asked."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import pytest

from plr.protos.model.redundancy_mode import RedundancyMode
from plr.sidecar.core.base.values import PathId, PathState, RejectReason
from plr.sidecar.core.robot.dispatch.dispatcher import MAX_COPIES_OF_REQUEST
from plr.sidecar.core.seam.application import ResponseArrived
from plr.sidecar.core.seam.links import Seek
from tests.support.builders import WWAN, A, B, path, request_id
from tests.unit.sidecar.core.request_table import RACE, SERVERS, WLAN_A, WWAN_B, Table

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName


def test_with_no_path_the_request_waits_for_the_first_one_that_comes_up() -> None:
    table = Table()
    for known in SERVERS.values():
        table.routes.set_state(known, PathState.DOWN)
    table.submit()
    assert table.sent() == []
    table.change(WWAN_B, PathState.UP)
    assert table.sent() == [WWAN_B]


@pytest.mark.parametrize("state", [PathState.UNSTABLE, PathState.DOWN])
def test_trouble_on_the_only_path_sends_a_copy_elsewhere_if_idempotent(state: PathState) -> None:
    for idempotent, rescued in ((True, [WWAN_B]), (False, [])):
        table = Table(idempotent=idempotent)
        table.routes.set_state(WWAN_B, PathState.DOWN)
        table.submit()
        assert table.sent() == [WLAN_A]
        table.routes.set_state(WWAN_B, PathState.UP)
        table.change(WLAN_A, state)
        assert table.sent() == rescued


def test_a_request_whose_only_path_died_goes_to_the_first_server_that_comes_within_reach() -> None:
    table = Table()
    table.routes.set_state(WWAN_B, PathState.DOWN)
    table.submit()
    assert table.sent() == [WLAN_A]
    table.change(WLAN_A, PathState.DOWN)
    table.table.handle_timer(1.0)
    assert table.sent() == []
    table.change(WWAN_B, PathState.UP, now=2.0)
    assert table.sent() == [WWAN_B]


def test_flapping_paths_do_not_multiply_copies_without_end() -> None:
    table = Table()
    table.submit()
    for turn in range(50):
        for known in SERVERS.values():
            table.change(known, PathState.UNSTABLE, now=turn * 0.01)
        for known in SERVERS.values():
            table.change(known, PathState.UP, now=turn * 0.01)
    assert len(table.sent()) <= MAX_COPIES_OF_REQUEST


@pytest.mark.parametrize("reason", RejectReason)
def test_a_rejected_request_goes_to_another_server_only_where_that_is_allowed(reason: RejectReason) -> None:
    table = Table(idempotent=False)
    table.submit()
    assert table.sent() == [WLAN_A]
    table.reject(reason)
    if reason.certainly_not_run:
        assert table.sent() == [WWAN_B]
        assert table.events == []
        table.respond(B, copy=1)
        assert isinstance(table.events[0], ResponseArrived)
    else:
        assert table.sent() == []
        assert table.only_failure().outcome == "rejected"
    table.assert_empty()


def test_a_request_that_all_servers_reject_fails_with_the_last_reason() -> None:
    table = Table()
    table.submit()
    table.reject(RejectReason.OVERLOADED, A, 0)
    assert table.events == []
    table.reject(RejectReason.BAD_PAYLOAD, B, 1)
    assert "bad payload: why" in table.only_failure().reason
    table.assert_empty()


@pytest.mark.parametrize("reason", [RejectReason.NOT_OFFERED, RejectReason.BAD_PAYLOAD])
def test_who_refused_while_starting_is_asked_again_when_all_else_is_lost(reason: RejectReason) -> None:
    """A cloud's sidecar is up before its ROS side is; meanwhile the other cloud dies."""
    table = Table()
    table.submit()
    table.sent()
    table.reject(reason, B, 1)
    assert table.sent() == [], "the other copy is on its way"
    table.change(WLAN_A, PathState.DOWN)
    assert table.sent() == ([WWAN_B] if reason.certainly_not_run else [])
    assert table.events == []


def test_a_second_rejection_of_a_copy_changes_nothing() -> None:
    table = Table()
    table.submit()
    table.sent()
    for _ in range(5):
        table.reject(RejectReason.OVERLOADED, A, 0)
    assert table.sent() == []
    assert table.events == []


def test_when_its_server_goes_a_request_that_may_not_run_twice_fails_and_another_is_sent_on() -> None:
    table = Table(idempotent=False)
    table.submit()
    table.table.on_peer_gone(A, 0.1)
    assert "may have run" in table.only_failure().reason
    table = Table()
    table.routes.set_state(WWAN_B, PathState.DOWN)
    table.submit()
    table.routes.set_state(WWAN_B, PathState.UP)
    table.routes.forget_peer(A)
    table.sent()
    table.table.on_peer_gone(A, 0.1)
    assert table.sent() == [WWAN_B]
    assert table.events == []


def test_a_request_that_may_have_run_is_not_taken_back_although_a_later_copy_never_left() -> None:
    table = Table(idempotent=False)
    wwan_a = path(WWAN, A)
    table.routes.set_state(wwan_a, PathState.UP)
    table.submit(begun=False)
    assert table.sent() == [WLAN_A, wwan_a]
    request = table.parts.in_flight.get(request_id(1))
    assert request is not None
    request.copies[0].message.symbols.begun = True
    for gone in (WLAN_A, wwan_a):
        table.routes.set_state(gone, PathState.DOWN)
    table.table.on_peer_gone(A, 0.2)
    table.finish(0.2)
    assert table.sent() == []
    assert "may have run" in table.only_failure().reason


def test_a_request_without_any_path_has_the_links_look_for_one() -> None:
    table = Table()
    table.submit(1)
    assert not sought(table)
    for known in SERVERS.values():
        table.routes.set_state(known, PathState.DOWN)
    table.submit(2)
    assert sought(table) == [frozenset((A, B))]


def sought(table: Table) -> list[frozenset[NodeName]]:
    """The servers that links were asked to look for."""
    return [command.peers for command in table.commands if isinstance(command, Seek)]


def siblings(table: Table, number: int = 1) -> list[PathId]:
    """Over which paths those copies travel that may leave the request to each other."""
    request = table.table._requests.get(request_id(number))
    assert request is not None
    shared = request.copies[-1].message.symbols.siblings
    return [copy.path for copy in request.copies if copy.message.symbols in shared]


def test_copies_of_a_request_may_leave_it_to_each_other_except_in_a_full_race() -> None:
    table = Table()
    table.submit()
    assert siblings(table) == [WLAN_A, WWAN_B]
    table.submit(RACE)
    assert siblings(table, RACE) == []


def test_nothing_is_left_to_a_copy_that_was_refused_or_whose_server_or_path_is_gone() -> None:
    def refuse(table: Table) -> None:
        table.reject(RejectReason.OVERLOADED)

    def leave(table: Table) -> None:
        table.table.on_peer_gone(A, 0.1)

    def fall_silent(table: Table) -> None:
        table.change(WLAN_A, PathState.UNSTABLE)

    for happens in (refuse, leave, fall_silent):
        table = Table()
        table.submit()
        happens(table)
        assert siblings(table) == [WWAN_B], happens.__name__


def test_what_is_sent_in_trouble_is_left_to_nobody() -> None:
    table = Table()
    table.routes.set_state(WWAN_B, PathState.DOWN)
    table.submit()
    table.routes.set_state(WWAN_B, PathState.UP)
    table.change(WLAN_A, PathState.UNSTABLE)
    assert siblings(table) == []


def test_messages_do_not_hold_each_other_in_memory_when_their_request_is_over() -> None:
    table = Table()
    table.submit()
    request = table.table._requests.get(request_id(1))
    assert request is not None
    shared = request.messages
    assert len(shared) == 2
    table.respond(A)
    table.table.handle_timer(20.0)
    assert not table.table._requests
    assert shared == []


@pytest.mark.parametrize("mode", [RedundancyMode.HEDGE, RedundancyMode.ADAPTIVE, RedundancyMode.REPLICATE])
def test_a_copy_that_comes_late_as_the_first_one_died_is_looked_at_as_that_one_was(mode: RedundancyMode) -> None:
    table = Table()
    table.rule = dataclasses.replace(table.rule, redundancy=mode)
    table.routes.set_state(WWAN_B, PathState.DOWN)
    table.submit()
    assert table.sent() == [WLAN_A]
    table.routes.set_state(WLAN_A, PathState.DOWN)
    table.table.on_peer_gone(A, 0.1)
    table.table.handle_timer(0.55)  # half of the deadline is over: nothing to look at
    assert table.sent() == []
    table.change(WLAN_A, PathState.UP, now=0.6)
    assert table.sent() == [WLAN_A]
    table.routes.set_state(WWAN_B, PathState.UP)
    table.outbox.on_finished(A, max(table.outbox._messages))
    for now in (0.7, 0.8, 0.9, 0.99):
        table.table.handle_timer(now)
    assert table.sent() == [WWAN_B], "its server is silent as well"
