"""Requests that wait for a path, more of them than the outbox takes at once when it comes."""

from __future__ import annotations

import pytest

from sidecar.core.fragments import MAX_PEER_BYTES
from sidecar.core.path_id import PathState
from tests.unit.sidecar.core.builders import ECHO, A, request_id
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
        table.table.on_room(1.0)
    assert table.sent() == [WLAN_A] * (ASKED - fit), "one after the other, not all that wait for each that is answered"
    for number in range(fit + 1, ASKED + 1):
        table.respond(number=number, now=2.0)
    table.assert_empty()


def test_what_is_over_leaves_no_trace_among_those_that_wait_for_room() -> None:
    table = crowded()
    assert table.sent()
    table.table.answered_here(request_id(ASKED), 0.5)
    table.handle_timers(1.0)
    assert table.table.unanswered == ASKED - 1
    for step in table.table.withdraw(ECHO, ""):
        step(2.0)
    assert table.table._no_room.services() == []
    table.table.on_room(2.0)
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
    table.table.on_room(1.0)
    assert table.sent() == []
    assert table.outbox.messages_to(A) == fit
