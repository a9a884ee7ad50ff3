from __future__ import annotations

from itertools import pairwise

import pytest

from plr.protos.model.ids import NodeName, ServiceName
from plr.sidecar.core.base.fair_share import FORGOTTEN_AT_ONCE
from plr.sidecar.core.base.slices import Backlog
from plr.sidecar.core.base.values import ExecutionId, RejectReason
from plr.sidecar.core.cloud import executions as dedup
from plr.sidecar.core.cloud.executions import (
    MAX_CACHED_BYTES,
    MAX_RUNNING,
    MAX_WAITERS,
    MIN_REMEMBER_S,
    SAY_WITHIN_S,
    TIMER_SLACK,
    ExecutionTable,
    Reply,
    ReplyTo,
)
from plr.sidecar.core.rules.service_rule import MAX_LIFETIME_S
from plr.sidecar.core.seam.application import AbandonExecution, CancelExecution, ExecuteRequest
from plr.sidecar.core.seam.stats import EngineStats
from plr.sidecar.core.wire.messages import MAX_PAYLOAD_BYTES, RejectionMessage, RequestMessage, ResponseMessage
from tests.support.builders import ECHO, path, request

ROBOT = path(peer="robot")
ROBOT_2ND = path(peer="robot", remote=1)
OTHER = path(peer="other")


def table() -> ExecutionTable:
    return ExecutionTable(EngineStats())


def run(executions: ExecutionTable, message: RequestMessage, now: float = 1.0) -> ExecuteRequest:
    outcome = executions.on_request(ROBOT, message, now)
    assert isinstance(outcome, ExecuteRequest)
    return outcome


def test_copies_of_a_running_request_wait_and_all_get_the_answer() -> None:
    executions = table()
    execution = run(executions, request(copy=0))
    assert execution.payload == b"question"
    assert executions.on_request(ROBOT_2ND, request(copy=1), 1.1) is None
    assert executions.on_request(ROBOT_2ND, request(copy=1), 1.2) is None, "a duplicate"
    replies = executions.complete(execution.execution, b"answer", 0.05, 1.3)
    assert [reply.to for reply in replies] == [ReplyTo(ROBOT, 0), ReplyTo(ROBOT_2ND, 1)]
    for reply in replies:
        assert reply.message == ResponseMessage(request().request_id, reply.to.copy, 0.05, b"answer")
    stats = executions._stats.executions
    assert (stats[ECHO, "run"], stats[ECHO, "coalesced"]) == (1, 2)


def test_one_robots_running_requests_are_capped_in_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dedup, "MAX_RUNNING_BYTES", 4 * len(b"question"))
    executions = table()
    running = [run(executions, request(number)) for number in range(2)]
    refusal = executions.on_request(ROBOT, request(2), 1.0)
    assert isinstance(refusal, Reply)
    assert isinstance(refusal.message, RejectionMessage)
    assert refusal.message.reason is RejectReason.OVERLOADED
    assert executions._stats.dropped["executions_full"] == 1
    assert isinstance(executions.on_request(OTHER, request(3), 1.0), ExecuteRequest)
    for execution in running:
        executions.complete(execution.execution, b"answer", 0.0, 1.1)
    run(executions, request(4))


def test_a_late_copy_gets_the_cached_answer_and_is_not_run() -> None:
    executions = table()
    executions.complete(run(executions, request()).execution, b"answer", 0.05, 1.1)
    reply = executions.on_request(ROBOT_2ND, request(copy=1), 5.0)
    assert isinstance(reply, Reply)
    assert isinstance(reply.message, ResponseMessage)
    assert (reply.message.copy, reply.message.payload) == (1, b"answer")


def test_a_second_answer_is_counted_and_dropped() -> None:
    executions = table()
    execution = run(executions, request()).execution
    assert executions.complete(execution, b"one", 0.0, 1.1)
    assert executions.complete(execution, b"two", 0.0, 1.2) == []
    assert executions.refuse(ExecutionId(99), RejectReason.SERVER_LOST, "", 1.2) == []
    assert executions._stats.dropped["answer_to_unknown_execution"] == 2
    reply = executions.on_request(ROBOT, request(copy=1), 1.3)
    assert isinstance(reply, Reply)
    assert isinstance(reply.message, ResponseMessage)
    assert reply.message.payload == b"one"


@pytest.mark.parametrize("reason", RejectReason)
def test_a_refused_request_runs_again_only_when_it_certainly_has_not(reason: RejectReason) -> None:
    executions = table()
    (reply,) = executions.refuse(run(executions, request()).execution, reason, "why", 1.1)
    assert reply.message == RejectionMessage(request().request_id, 0, reason, "why")
    again = executions.on_request(ROBOT, request(copy=1), 1.2)
    assert isinstance(again, ExecuteRequest) is reason.certainly_not_run
    if isinstance(again, Reply):
        assert isinstance(again.message, RejectionMessage)
        assert again.message.reason is reason


def test_an_answer_too_large_is_a_rejection_that_says_so() -> None:
    executions = table()
    execution = run(executions, request()).execution
    (reply,) = executions.complete(execution, bytes(MAX_PAYLOAD_BYTES + 1), 0.0, 1.1)
    assert isinstance(reply.message, RejectionMessage)
    assert reply.message.reason is RejectReason.TOO_LARGE


def test_an_execution_nobody_waits_for_is_abandoned_and_never_run_again() -> None:
    executions = table()
    execution = run(executions, request(lifetime_s=5.0)).execution
    assert executions.next_timer() == 6.0
    executions.on_request(ROBOT_2ND, request(copy=1, lifetime_s=7.0), 2.0)
    assert executions.handle_timer(6.0, Backlog()) == ([], []), "the second copy waits longer"
    assert executions.next_timer() == 9.0
    (abandoned,), replies = executions.handle_timer(9.0, Backlog())
    assert replies == [], "nobody waits any more"
    assert abandoned.execution == execution
    assert executions.running == 0
    assert executions.next_timer() is None
    reply = executions.on_request(ROBOT, request(copy=2), 9.1)
    assert isinstance(reply, Reply)
    assert isinstance(reply.message, RejectionMessage)
    assert reply.message.reason is RejectReason.SERVER_LOST


def test_lifetimes_from_the_wire_are_cut() -> None:
    execution = run(table(), request(lifetime_s=1e6))
    assert execution.expires_s == MAX_LIFETIME_S


@pytest.mark.parametrize("lifetime_s", [1.0, MAX_LIFETIME_S])
def test_an_id_is_remembered_twice_as_long_as_any_copy_may_come(lifetime_s: float) -> None:
    executions = table()
    executions.complete(run(executions, request(1, lifetime_s=lifetime_s)).execution, b"answer", 0.0, 2.0)
    remembered_s = max(2 * lifetime_s, MIN_REMEMBER_S)
    run(executions, request(2), 2.0 + remembered_s - 0.1)
    assert executions.knows(ROBOT.peer, request(1).request_id)
    run(executions, request(3), 2.0 + remembered_s)
    assert not executions.knows(ROBOT.peer, request(1).request_id)
    assert executions._cache.held_bytes == 0


def test_cached_answers_are_capped_in_bytes_and_their_ids_stay() -> None:
    executions = table()
    size = 16 * 1024 * 1024
    for number in range(MAX_CACHED_BYTES // size + 1):
        executions.complete(run(executions, request(number)).execution, bytes(size), 0.0, 1.0)
    assert executions._cache.held_bytes == MAX_CACHED_BYTES
    assert executions._stats.dropped["cached_answer_evicted"] == 1
    reply = executions.on_request(ROBOT, request(0, copy=1), 1.1)
    assert isinstance(reply, Reply)
    assert isinstance(reply.message, RejectionMessage)
    assert reply.message.reason is RejectReason.FORGOTTEN


def test_an_id_used_for_another_service_is_dropped() -> None:
    executions = table()
    run(executions, request(1))
    assert executions.on_request(ROBOT, request(1, service=ServiceName("/else")), 1.1) is None
    assert executions._stats.dropped["request_id_mismatch"] == 1


def test_who_sends_the_id_of_anothers_request_first_takes_nothing_from_it() -> None:
    executions = table()
    theirs = executions.on_request(OTHER, request(1, service=ServiceName("/else")), 1.0)
    assert isinstance(theirs, ExecuteRequest)
    executions.cancel(OTHER.peer, request(2).request_id, 1.0)
    executions.cancel(OTHER.peer, request(1).request_id, 1.0)
    mine = run(executions, request(1), 1.1)
    run(executions, request(2), 1.1)
    (reply,) = executions.complete(mine.execution, b"secret", 0.0, 1.2)
    assert reply.to.path == ROBOT
    again = executions.on_request(OTHER, request(1, service=ServiceName("/else"), copy=1), 1.3)
    assert again is None, "nor does the cache tell others"


def test_who_fills_the_cache_pushes_out_its_own_answers() -> None:
    executions = table()
    executions.complete(run(executions, request(0)).execution, b"mine", 0.0, 1.0)
    for number in range(1, 200):
        theirs = executions.on_request(OTHER, request(number), 1.0)
        assert isinstance(theirs, ExecuteRequest)
        executions.complete(theirs.execution, bytes(MAX_CACHED_BYTES // 100), 0.0, 1.0)
    reply = executions.on_request(ROBOT, request(0, copy=1), 1.1)
    assert isinstance(reply, Reply)
    assert isinstance(reply.message, ResponseMessage)
    assert executions._cache.held_bytes <= MAX_CACHED_BYTES


def test_a_request_called_off_before_its_server_got_it_never_runs_and_nobody_is_told() -> None:
    executions = table()
    execution = run(executions, request()).execution
    assert executions.cancel(ROBOT.peer, request().request_id, 1.1) == CancelExecution(execution, ROBOT.peer)
    assert executions.cancel(ROBOT.peer, request().request_id, 1.1) is None, "a duplicate"
    assert executions.on_request(ROBOT_2ND, request(copy=1), 1.2) is None
    assert executions.refuse(execution, RejectReason.CANCELLED, "", 1.3) == []
    assert executions.on_request(ROBOT_2ND, request(copy=2), 1.4) is None
    stats = executions._stats.executions
    assert (stats[ECHO, "run"], stats[ECHO, "cancelled"]) == (1, 3)


def test_a_request_called_off_while_it_runs_is_remembered_and_its_answer_is_not() -> None:
    executions = table()
    execution = run(executions, request()).execution
    executions.cancel(ROBOT.peer, request().request_id, 1.1)
    assert executions.complete(execution, b"answer", 0.05, 1.3) == []
    assert executions._cache.held_bytes == 0
    assert executions.on_request(ROBOT_2ND, request(copy=1), 1.4) is None


def test_a_request_called_off_after_it_ran_frees_its_cached_answer() -> None:
    executions = table()
    executions.complete(run(executions, request()).execution, b"answer", 0.05, 1.1)
    assert executions.cancel(ROBOT.peer, request().request_id, 1.2) is None
    assert executions._cache.held_bytes == 0
    assert executions.on_request(ROBOT_2ND, request(copy=1), 1.4) is None
    run(executions, request(2), 1.2 + 2 * MIN_REMEMBER_S)
    assert not executions.knows(ROBOT.peer, request().request_id)


def test_a_robot_that_said_goodbye_is_not_waited_for() -> None:
    executions = table()
    mine = run(executions, request(1))
    assert isinstance(executions.on_request(OTHER, request(2), 1.0), ExecuteRequest)
    both = (ROBOT.peer, OTHER.peer)
    assert executions.awaited(both) == 2
    assert executions.awaited((OTHER.peer,)) == 1
    (awaited,) = executions.of_robot(ROBOT.peer)
    assert executions.call_off(ROBOT.peer, awaited) == CancelExecution(mine.execution, ROBOT.peer)
    assert executions.of_robot(ROBOT.peer) == []
    assert (executions.awaited(both), executions.running) == (1, 2)
    assert executions.complete(mine.execution, b"answer", 0.0, 1.1) == []


def test_a_cancel_that_overtakes_its_request_holds() -> None:
    executions = table()
    executions.cancel(ROBOT.peer, request().request_id, 1.0)
    assert executions.on_request(ROBOT, request(), 1.1) is None
    assert executions.on_request(ROBOT_2ND, request(copy=1), 1.2) is None
    assert executions.running == 0
    run(executions, request(2), 1.3)


def test_a_cancel_by_another_robot_changes_nothing() -> None:
    executions = table()
    assert executions.cancel(OTHER.peer, request(2).request_id, 0.9) is None
    execution = run(executions, request()).execution
    run(executions, request(2))
    assert executions.cancel(OTHER.peer, request().request_id, 1.1) is None
    assert len(executions.complete(execution, b"answer", 0.05, 1.2)) == 1
    assert executions.cancel(OTHER.peer, request().request_id, 1.3) is None
    assert isinstance(executions.on_request(ROBOT, request(copy=1), 1.4), Reply)


def test_waiters_are_capped() -> None:
    executions = table()
    execution = run(executions, request()).execution
    for copy in range(1, 255):
        executions.on_request(ROBOT, request(copy=copy), 1.1)
    assert len(executions.complete(execution, b"", 0.0, 1.2)) == MAX_WAITERS


def test_a_full_table_refuses_one_robot_and_still_serves_another() -> None:
    executions = table()
    for number in range(MAX_RUNNING // 2):
        run(executions, request(number))
    reply = executions.on_request(ROBOT, request(99_999), 1.0)
    assert isinstance(reply, Reply)
    assert isinstance(reply.message, RejectionMessage)
    assert reply.message.reason is RejectReason.OVERLOADED
    assert executions._stats.dropped["executions_full"] == 1
    assert not executions.knows(ROBOT.peer, request(99_999).request_id)
    assert isinstance(executions.on_request(OTHER, request(100_000), 1.0), ExecuteRequest)
    executions.complete(ExecutionId(0), b"", 0.0, 1.1)
    executions.complete(ExecutionId(1), b"", 0.0, 1.1)
    run(executions, request(99_999, copy=1), 1.2)


def test_remembered_ids_are_capped_per_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dedup, "MAX_REMEMBERED_IDS", 20)
    executions = table()
    for number in range(10):
        executions.complete(run(executions, request(number)).execution, b"", 0.0, 1.0)
    assert isinstance(executions.on_request(ROBOT, request(10), 1.0), Reply)
    assert isinstance(executions.on_request(OTHER, request(11), 1.0), ExecuteRequest)
    run(executions, request(10, copy=1), 1.0 + MIN_REMEMBER_S)


def test_what_is_over_leaves_no_timers_behind() -> None:
    executions = table()
    for number in range(5 * TIMER_SLACK):
        execution = run(executions, request(number, lifetime_s=MAX_LIFETIME_S)).execution
        executions.refuse(execution, RejectReason.BAD_PAYLOAD, "", 1.0)
    assert len(executions._timers) <= TIMER_SLACK + 1
    assert not executions._forget_at
    while executions.next_timer() is not None:
        pass


@pytest.mark.audit("dp-10")
def test_what_many_requests_leave_is_not_forgotten_in_one_call() -> None:
    executions = table()
    for number in range(1000):
        executions.complete(run(executions, request(number)).execution, b"answer", 0.0, 1.0)
    now = 1.0 + MIN_REMEMBER_S
    left = [len(executions._finished)]
    while left[-1]:
        executions.handle_timer(now, Backlog())
        left.append(len(executions._finished))
    assert max(before - after for before, after in pairwise(left)) <= FORGOTTEN_AT_ONCE
    assert not executions._cache.held_bytes


def test_unknown_services_make_no_counters() -> None:
    executions = table()
    for number in range(100):
        message = request(number, service=ServiceName(f"/made/up/{number}"))
        executions.refuse_unseen(ReplyTo(ROBOT, 0), message, RejectReason.NOT_OFFERED, "", 1.0)
    assert not executions._stats.executions
    assert executions._stats.dropped["request_for_unknown_service"] == 100


def test_robots_are_told_apart_by_name() -> None:
    executions = table()
    assert run(executions, request()).robot == NodeName("robot")


def test_a_server_is_given_up_before_the_robot_gives_up_and_the_robot_is_told() -> None:
    executions = table()
    outcome = executions.on_request(ROBOT, request(lifetime_s=20.0), 1.0, patience_s=3.0)
    assert isinstance(outcome, ExecuteRequest)
    assert outcome.expires_s == 3.0
    assert executions.handle_timer(3.9, Backlog()) == ([], [])
    assert executions.handle_timer(4.0, Backlog()) == (
        [AbandonExecution(outcome.execution, ROBOT.peer, awaited=True)],
        [],
    )
    assert executions.next_timer() == 4.0 + SAY_WITHIN_S
    nothing, (reply,) = executions.handle_timer(4.0 + SAY_WITHIN_S, Backlog())
    assert nothing == [], "it was told before"
    assert isinstance(reply.message, RejectionMessage)
    assert reply.message.reason is RejectReason.SERVER_LOST
    assert executions._stats.executions[ECHO, "abandoned"] == 1


@pytest.mark.audit("dp-10")
def test_what_its_server_never_got_may_run_elsewhere_when_its_patience_is_over() -> None:
    executions = table()
    outcome = executions.on_request(ROBOT, request(lifetime_s=20.0), 1.0, patience_s=3.0)
    assert isinstance(outcome, ExecuteRequest)
    executions.handle_timer(4.0, Backlog())
    (reply,) = executions.refuse(outcome.execution, RejectReason.OVERLOADED, "no room at the server", 4.1)
    assert isinstance(reply.message, RejectionMessage)
    assert reply.message.reason.certainly_not_run
    assert executions.running == 0
    assert executions.handle_timer(5.0, Backlog()) == ([], [])
    assert executions._stats.executions[ECHO, "refused"] == 0, "it was counted as abandoned"
