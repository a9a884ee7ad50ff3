"""Requests that wait for a path, more of them than the outbox takes at once when it comes."""

from __future__ import annotations

from dataclasses import replace

import pytest

from plr.sidecar.core.base.values import PathState, Priority
from plr.sidecar.core.message.reassembly import MAX_PEER_BYTES
from plr.sidecar.core.transfer.room import LARGE_ROOM_BYTES, SMALL_BYTES
from plr.sidecar.core.wire.messages import Encoded
from tests.support.builders import ECHO, A, request_id
from tests.unit.sidecar.core.request_table import WLAN_A, WWAN_B, Table

SIZE = 1_000_000
FIT = MAX_PEER_BYTES // SIZE
ASKED = FIT + 20


def crowded() -> Table:
    """One path has come up to one server; as many requests as fit are on their way."""
    table = Table(idempotent=False)
    for known in (WLAN_A, WWAN_B):
        table.routes.set_state(known, PathState.DOWN)
    for number in range(1, ASKED + 1):
        table.submit(number, bytes(SIZE))
    assert table.sent() == []
    table.change(WLAN_A, PathState.UP)
    return table


def test_what_found_no_room_is_sent_as_answers_make_it() -> None:
    table = crowded()
    fit = len(table.sent())
    assert 0 < fit < ASKED
    for number in range(1, fit + 1):
        table.respond(number=number, now=1.0)
        table.use_room(1.0)
    assert table.sent() == [WLAN_A] * (ASKED - fit), "one after the other, not all that wait for each that is answered"
    for number in range(fit + 1, ASKED + 1):
        table.respond(number=number, now=2.0)
    table.assert_empty()


def test_what_is_over_leaves_no_trace_among_those_that_wait_for_room() -> None:
    table = crowded()
    assert table.sent()
    table.table.answered_locally(request_id(ASKED), 0.5)
    table.handle_timers(1.0)
    assert table.table.unanswered == ASKED - 1
    for step in table.table.withdraw(ECHO, ""):
        step(2.0)
    assert len(table.table._no_room) == 0
    table.use_room(2.0)
    assert table.sent() == []
    assert table.table.unanswered == 0


def test_a_request_that_found_no_room_until_its_end_says_so() -> None:
    table = crowded()
    table.handle_timers(20.0)
    reasons = {event.reason for event in table.events if hasattr(event, "reason")}
    assert reasons == {"no answer within 10 s", "no room to send it within 10 s"}


@pytest.mark.parametrize("state", [PathState.UNSTABLE, PathState.UP])
def test_another_path_is_no_room(state: PathState) -> None:
    """To a server that is as full."""
    table = crowded()
    fit = len(table.sent())
    table.change(WLAN_A, PathState.UNSTABLE)
    table.change(WLAN_A, state)
    table.use_room(1.0)
    assert table.sent() == []
    assert table.outbox.messages_to(A) == fit


def one_server() -> Table:
    """Only cloud-a is reached."""
    table = Table(idempotent=False)
    table.routes.set_state(WWAN_B, PathState.DOWN)
    return table


@pytest.mark.audit("dp-1")
def test_six_requests_of_16_mb_at_once_wait_and_all_go() -> None:
    table = one_server()
    for number in range(1, 7):
        table.submit(number, bytes(16_000_000))
    assert not table.events
    assert table.sent() == [WLAN_A] * 3
    for number in range(1, 7):
        table.respond(number=number)
        table.use_room(0.2)
    assert table.sent() == [WLAN_A] * 3
    assert len(table.events) == 6
    table.table.handle_timer(1.0)
    table.assert_empty()


@pytest.mark.audit("dp-1")
def test_a_small_request_does_not_wait_for_a_large_one_nor_take_its_turn() -> None:
    table = one_server()
    for number in range(1, 5):
        table.submit(number, bytes(16_000_000))
    table.sent()
    table.submit(5, bytes(100_000))
    assert table.sent() == [WLAN_A]
    # As large as what waits, and there would be room: but it came later.
    table.submit(6, bytes(300_000), now=0.1)
    assert table.sent() == []
    table.respond(number=1)
    table.use_room(0.2)
    waited = [len(message.symbols.content.payload) for message in table.outbox._messages.values()][-2:]
    assert waited == [16_000_000, 300_000]


def test_a_more_urgent_request_goes_before_those_that_wait() -> None:
    table = one_server()
    for number in range(1, 5):
        table.submit(number, bytes(16_000_000))
    table.sent()
    table.rule = replace(table.rule, priority=Priority.HIGH)
    table.submit(5, bytes(300_000))
    assert table.sent() == [WLAN_A]


def test_a_request_whose_head_makes_it_too_long_waits_as_well() -> None:
    table = one_server()
    for number in range(1, 4):
        table.submit(number, bytes(16_000_000))
    table.submit(4, bytes(LARGE_ROOM_BYTES - table.outbox.held_bytes - 2 * SMALL_BYTES))
    assert len(table.sent()) == 4
    table.submit(5, bytes(LARGE_ROOM_BYTES - table.outbox.held_bytes))
    assert table.sent() == []
    table.respond(number=1)
    table.use_room(0.2)
    assert table.sent() == [WLAN_A]


@pytest.mark.audit("dp-7")
@pytest.mark.parametrize("begun", [True, False])
def test_what_left_may_have_run_and_what_did_not_has_not(begun: bool) -> None:
    table = Table(idempotent=False)
    table.submit(begun=False)
    (message,) = table.outbox._messages.values()
    assert table.sent() == [WLAN_A]
    if begun:
        message.symbols.symbol_data(0)
        # Cut again, with nothing of the second message under way.
        table.outbox.on_forgotten(A, message.number)
    table.outbox.drop_peer(A)
    table.routes.set_state(WLAN_A, PathState.DOWN)
    table.table.on_peer_gone(A, 0.2)
    assert (table.sent()[-1:] == [WWAN_B]) is not begun
    assert bool(table.events) is begun


@pytest.mark.audit("dp-7")
def test_what_never_left_waits_for_room_at_the_other_server() -> None:
    table = Table(idempotent=False)
    table.submit(1, bytes(16_000_000), begun=False)
    huge = Encoded(b"", bytes(16_000_000))
    others = [table.outbox.send(WWAN_B, huge, priority=Priority.NORMAL, deadline=9.0, expires=9.0) for _ in range(3)]
    table.sent()
    table.outbox.drop_peer(A)
    table.routes.set_state(WLAN_A, PathState.DOWN)
    table.table.on_peer_gone(A, 0.2)
    assert table.sent() == []
    assert not table.events
    table.outbox.drop(others[0])
    table.use_room(0.3)
    assert table.sent() == [WWAN_B]
