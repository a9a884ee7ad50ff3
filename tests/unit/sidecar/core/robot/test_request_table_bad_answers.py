"""Answers that cannot be delivered: their copies have failed, and others answer in their place."""

from __future__ import annotations

import pytest

from plr.sidecar.core.base.values import PathState, RejectReason
from plr.sidecar.core.robot.dispatch.penalties import FIRST_S
from plr.sidecar.core.seam.application import DeadlineMissed, ResponseArrived
from tests.support.builders import ECHO, A, B, request_id
from tests.unit.sidecar.core.request_table import RACE, WLAN_A, WWAN_B, Table

pytestmark = pytest.mark.audit("sec-2")


def judging(*, idempotent: bool = True, drop_late: bool = False) -> Table:
    """A table whose answers wait for the test's judgement."""
    table = Table(idempotent=idempotent, drop_late=drop_late)
    table.judges = False
    return table


def test_a_race_goes_on_after_a_bad_answer() -> None:
    table = judging()
    table.submit(RACE)
    table.respond(A, copy=0, number=RACE, now=0.1)
    table.judge(0.11, "garbage")
    table.respond(B, copy=1, number=RACE, now=0.2)
    table.judge(0.21)
    assert [type(event) for event in table.events] == [ResponseArrived] * 2
    assert table.stats.requests == {(ECHO, "ok"): 1}
    assert table.stats.bad_answers == {(A, ECHO): 1}
    assert table.latencies() == {A: (0, 1), B: (1, 0)}, "a bad answer tells nothing good of its server"
    table.assert_empty()


def test_nobody_is_called_off_before_the_answer_is_judged() -> None:
    table = judging()
    table.submit(1)
    table.respond(A, copy=0, now=0.1)
    assert table.cancelled() == []
    table.judge(0.11, "garbage")
    assert table.cancelled() == []
    table.respond(B, copy=1, now=0.2)
    table.judge(0.21)
    assert table.stats.requests == {(ECHO, "ok"): 1}
    table.assert_empty()


def test_with_two_bad_answers_both_are_asked_no_more_and_the_request_ends_with_its_reason() -> None:
    table = judging()
    table.submit(1)
    table.respond(A, copy=0, now=0.1)
    table.respond(B, copy=1, now=0.1001)
    table.judge(0.11, "garbage")
    assert table.stats.bad_answers == {(A, ECHO): 1, (B, ECHO): 1}
    assert "bad answer from cloud-b" in table.only_failure().reason
    table.assert_empty()


def test_the_second_answer_counts_though_it_came_while_the_first_was_judged() -> None:
    table = judging()
    table.submit(1)
    table.respond(A, copy=0, now=0.1)
    table.respond(B, copy=1, now=0.1001)
    table.table.judge_answer(request_id(1), 0, "garbage", 0.11)
    table.table.judge_answer(request_id(1), 1, None, 0.11)
    assert table.stats.requests == {(ECHO, "ok"): 1}
    table.assert_empty()


def test_its_server_is_asked_for_nothing_for_a_while_where_another_is() -> None:
    table = judging()
    table.submit(RACE)
    table.respond(A, copy=0, number=RACE, now=0.1)
    table.judge(0.1, "garbage")
    table.respond(B, copy=1, number=RACE, now=0.2)
    table.judge(0.2)
    table.sent()
    table.submit(2 * RACE, now=0.3)
    assert {path.peer for path in table.sent()} == {B}
    table.submit(3 * RACE, now=0.2 + FIRST_S)
    assert {path.peer for path in table.sent()} == {A, B}


def test_what_may_run_only_once_fails_with_its_reason() -> None:
    table = judging(idempotent=False)
    table.submit(1)
    copies = len(table.sent())
    table.respond(A, copy=0, now=0.1)
    table.judge(0.1, "garbage")
    assert copies == 1
    failure = table.only_failure()
    assert failure.outcome == "failed"
    assert "bad answer from cloud-a" in failure.reason
    assert "garbage" in failure.reason
    table.assert_empty()


def test_an_answer_that_is_judged_over_the_deadline_came_in_time() -> None:
    table = judging()
    table.submit(1)
    table.respond(A, copy=0, now=0.99)
    table.handle_timers(1.0)
    table.judge(1.2)
    assert table.stats.requests == {(ECHO, "ok"): 1}
    assert not any(isinstance(event, DeadlineMissed) for event in table.events)


def test_a_bad_answer_over_the_deadline_is_a_miss() -> None:
    table = judging()
    table.submit(1)
    table.respond(A, copy=0, now=0.99)
    table.handle_timers(1.0)
    table.judge(1.2, "garbage")
    assert [event for event in table.events if isinstance(event, DeadlineMissed)] != []
    table.respond(B, copy=1, now=1.3)
    table.judge(1.3)
    assert table.stats.requests == {(ECHO, "deadline_missed"): 1}


def test_nothing_more_is_sent_while_an_answer_is_judged() -> None:
    table = judging()
    table.submit(1)
    table.sent()
    table.respond(A, copy=0, now=0.1)
    table.change(WLAN_A, PathState.DOWN, 0.15)
    table.change(WWAN_B, PathState.DOWN, 0.15)
    table.change(WWAN_B, PathState.UP, 0.16)
    assert table.sent() == []
    table.judge(0.2)
    assert table.stats.requests == {(ECHO, "ok"): 1}


def test_a_word_on_what_nobody_asked_changes_nothing() -> None:
    table = judging()
    table.submit(1)
    for number, copy in ((1, 0), (1, 99), (2, 0)):
        table.table.judge_answer(request_id(number), copy, None, 0.1)
        table.table.judge_answer(request_id(number), copy, "garbage", 0.1)
    assert table.events == []
    assert table.stats.bad_answers == {}


@pytest.mark.parametrize("reason", [None, *RejectReason])
def test_a_good_answer_counts_though_the_other_copy_failed_while_it_was_judged(reason: RejectReason | None) -> None:
    table = judging()
    table.submit(RACE)
    table.respond(A, copy=0, number=RACE, now=0.1)
    if reason is None:
        table.table.on_peer_gone(B, 0.1)
    else:
        table.reject(reason, B, copy=1, number=RACE, now=0.1)
    table.judge(0.11)
    assert [type(event) for event in table.events] == [ResponseArrived]
    assert table.stats.requests == {(ECHO, "ok"): 1}


def test_an_answer_in_time_counts_though_a_late_one_came_while_it_was_judged() -> None:
    table = judging(drop_late=True)
    table.submit(RACE)
    table.respond(A, copy=0, number=RACE, now=0.99)
    table.respond(B, copy=1, number=RACE, now=1.01)
    table.judge(1.02)
    assert [type(event) for event in table.events] == [ResponseArrived]
    assert table.stats.requests == {(ECHO, "ok"): 1}


def test_a_server_that_refuses_and_answers_does_not_make_a_request_run_twice() -> None:
    table = judging(idempotent=False)
    table.submit(1)
    table.sent()
    table.reject(RejectReason.NOT_OFFERED, A)
    assert [path.peer for path in table.sent()] == [B]
    table.respond(A, copy=0, now=0.2)
    table.judge(0.2, "garbage")
    table.reject(RejectReason.NOT_OFFERED, B, copy=1, now=0.3)
    assert table.sent() == []
    assert table.only_failure().outcome == "rejected"
    table.assert_empty()
