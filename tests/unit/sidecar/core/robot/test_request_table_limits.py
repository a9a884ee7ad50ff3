"""What a request table takes on, and what it refuses."""

from __future__ import annotations

import pytest

from plr.sidecar.core.base.values import PathId, PathState, Priority
from plr.sidecar.core.robot import request_table as requests_module
from plr.sidecar.core.wire.messages import MAX_PAYLOAD_BYTES, Encoded
from tests.support.builders import ECHO, WWAN, A, B, path
from tests.unit.sidecar.core.request_table import WLAN_A, WWAN_B, Table


def test_what_cannot_be_sent_is_rejected_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    table = Table()
    table.submit(payload=bytes(MAX_PAYLOAD_BYTES + 1))
    assert "limit" in table.only_failure().reason
    table.events.clear()
    table.submit()
    table.submit()
    assert "identity" in table.only_failure().reason
    table.events.clear()
    monkeypatch.setattr(requests_module, "MAX_IN_FLIGHT", 1)
    table.submit(2)
    assert "in flight" in table.only_failure().reason
    assert table.stats.requests[ECHO, "rejected"] == 3


def test_requests_that_wait_are_capped_in_bytes_and_leave_room_when_they_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(requests_module, "MAX_REQUEST_TABLE_BYTES", 1000)
    table = Table()
    table.submit(1, payload=bytes(600))
    table.submit(2, payload=bytes(600))
    assert "bytes already" in table.only_failure().reason
    table.table.handle_timer(1.0)
    table.table.handle_timer(100.0)
    table.events.clear()
    table.submit(3, payload=bytes(600), now=100.0)
    assert not table.events


def fill(table: Table, over: PathId, content: Encoded) -> None:
    """Send this until there is no room for more."""
    while table.outbox.has_room(over.peer, content.size):
        table.outbox.send(over, content, priority=Priority.NORMAL, deadline=9.0, expires=9.0)


def test_a_full_outbox_towards_one_server_sends_to_the_other_only_and_two_full_ones_let_it_wait() -> None:
    table = Table()
    huge = Encoded(b"", bytes(8_000_000))
    fill(table, WLAN_A, huge)
    table.sent()
    table.submit(1, payload=bytes(8_000_000))
    assert table.sent() == [WWAN_B]
    fill(table, WWAN_B, huge)
    table.sent()
    table.submit(2, payload=bytes(8_000_000))
    assert table.sent() == []
    assert table.table.unanswered == 2
    assert not table.events
    table.outbox.drop(next(iter(table.outbox._messages.values())))
    table.table.on_room(0.5)
    assert table.sent() == [WLAN_A]


def test_a_second_copy_to_a_server_is_left_out_if_the_first_one_took_its_room() -> None:
    table = Table(idempotent=False)
    table.routes.forget_peer(B)
    table.routes.set_state(path(WWAN, A), PathState.UP)
    fill(table, WLAN_A, Encoded(b"", bytes(8_000_000)))
    table.outbox.drop(next(iter(table.outbox._messages.values())))
    table.sent()
    table.submit(1, payload=bytes(7_900_000))
    assert table.sent() == [WLAN_A]
    assert table.stats.dropped["outbox_full"] == 1


@pytest.mark.audit("dp-10")
def test_requests_that_are_over_leave_few_timers_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that is stuck is due before all of them, so that none comes up."""
    slack = 100
    monkeypatch.setattr(requests_module, "TIMER_SLACK", slack)
    table = Table()
    table.submit(1)
    for number in range(2, 10 * slack):
        table.submit(number, now=0.5)
        for copy, server in enumerate((A, B)):
            table.respond(server, copy, number, now=0.5)
        table.cancelled()
    assert len(table.table._requests) == 1
    assert len(table.table._timers) <= slack + 8
