"""From the request to its first answer, its missed deadline or its end."""

from __future__ import annotations

from plr.sidecar.core.base.values import PathState, Priority
from plr.sidecar.core.seam.application import DeadlineMissed, RequestFailed, ResponseArrived
from plr.sidecar.core.seam.links import Send
from plr.sidecar.core.wire.messages import RequestMessage, decode_message
from tests.support.builders import ECHO, TYPE, WWAN, A, B, request_id
from tests.unit.sidecar.core.request_table import RACE, WLAN_A, WWAN_B, Table


def test_copies_are_numbered_and_carry_what_is_left_of_the_lifetime() -> None:
    table = Table()
    table.submit()
    sends = [command for command in table.commands if isinstance(command, Send)]
    copies = [decode_message(memoryview(b"".join(send.message.content))) for send in sends]
    assert copies == [
        RequestMessage(request_id(1), copy, Priority.NORMAL, 1.0, 10.0, ECHO, TYPE, memoryview(b"question"))
        for copy in (0, 1)
    ]
    assert table.sent() == [WLAN_A, WWAN_B]


def test_the_first_response_wins_and_in_a_race_the_second_is_counted_and_measured() -> None:
    table = Table()
    table.submit(RACE)
    table.respond(B, copy=1, number=RACE, now=0.2)
    (arrived,) = table.events
    assert arrived == ResponseArrived(request_id(RACE), ECHO, 1, b"from cloud-b", B, WWAN, 0.2, late=False)
    assert table.cancelled() == []
    table.respond(A, copy=0, number=RACE, now=0.3)
    assert len(table.events) == 1
    assert table.stats.duplicate_responses == 1
    assert table.latencies() == {A: (1, 0), B: (1, 0)}
    table.assert_empty()


def test_responses_of_the_wrong_server_to_an_unknown_copy_or_request_are_ignored() -> None:
    table = Table()
    table.submit()
    table.respond(B, copy=0)
    table.respond(A, copy=7)
    table.respond(A, number=99)
    assert table.events == []
    assert table.stats.dropped == {
        "answer_from_wrong_server": 1,
        "answer_to_unknown_copy": 1,
        "answer_to_unknown_request": 1,
    }
    table.respond(A, copy=0)
    assert len(table.events) == 1


def test_a_missed_deadline_is_told_once_and_one_more_copy_goes_out() -> None:
    table = Table()
    table.change(WWAN_B, PathState.DOWN)
    table.submit()
    assert table.sent() == [WLAN_A]
    table.change(WWAN_B, PathState.UP)
    assert table.table.next_timer() == 0.5, "to ask another server if A has it and is silent; A does not have it"
    table.table.handle_timer(0.5)
    assert table.sent() == []
    assert table.table.next_timer() == 1.0
    table.table.handle_timer(1.0)
    table.table.handle_timer(1.0)
    (missed,) = table.events
    assert isinstance(missed, DeadlineMissed)
    assert table.sent() == [WWAN_B]
    table.respond(B, copy=1, now=2.0)
    arrived = table.events[-1]
    assert isinstance(arrived, ResponseArrived)
    assert arrived.late


def test_a_late_answer_may_be_dropped_but_the_request_still_ends() -> None:
    table = Table(drop_late=True)
    table.submit()
    table.respond(now=1.5)
    assert [type(event) for event in table.events] == [DeadlineMissed, RequestFailed]
    assert table.only_failure().outcome == "late_dropped"
    assert table.table.unanswered == 0


def test_a_request_that_nobody_answers_ends_with_its_lifetime() -> None:
    table = Table()
    table.submit(RACE)
    for now in (1.0, 10.0, 99.0):
        table.table.handle_timer(now)
    assert table.only_failure().outcome == "failed"
    assert table.latencies() == {A: (0, 1), B: (0, 1)}
    table.assert_empty()


def test_an_answer_from_a_server_given_up_still_counts_but_is_not_measured_twice() -> None:
    table = Table()
    table.submit(RACE)
    table.table.on_peer_gone(A, 0.1)
    table.respond(A, copy=0, number=RACE)
    assert isinstance(table.events[0], ResponseArrived)
    assert table.latencies()[A] == (0, 1)
