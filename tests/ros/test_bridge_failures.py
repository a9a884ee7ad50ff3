"""What the bridge does when servers, messages and deadlines go wrong: each costs its own request only."""

from __future__ import annotations

import logging
import os
import signal
import time
from collections import Counter
from typing import TYPE_CHECKING

import pytest

from plr.protos.model.ids import ServiceName
from plr.sidecar.core.base.values import RejectReason
from plr.sidecar.core.seam.application import AbandonExecution, CancelExecution
from plr.sidecar.ros.graph import graph
from tests.ros.loopback import ROBOT
from tests.ros.mesh import no_name, wait_until
from tests.ros.notice_listener import NoticeListener

if TYPE_CHECKING:
    from tests.ros.mesh import Mesh

pytestmark = pytest.mark.ros

PLAN = ServiceName("/plan")


def test_a_request_that_is_never_answered_costs_itself_only(mesh: Mesh) -> None:
    mesh.faults.lifetime_s = 12.0
    mesh.start()
    mesh.serve("--plan", "/plan", "--deep")
    mesh.wait_carried("/plan")
    # Every second request is ignored by the server; far more than fit in its window.
    result = mesh.result(mesh.call("/plan", "--count", "120", "--tolerance", "0", "-1", "--timeout-s", "16"))
    assert (result["answered"], result["wrong"], result["twice"]) == (60, 0, 0)
    wait_until(lambda: not mesh.robot.stats.pending and not mesh.cloud.stats.pending, "empty tables")
    assert mesh.robot.stats.unanswered == {("/plan", "failed"): 60}
    assert mesh.cloud.stats.abandoned[PLAN] == 60
    assert mesh.result(mesh.call("/plan", "--count", "20"))["answered"] == 20


def test_what_the_robot_calls_off_runs_only_if_the_server_has_it_already(mesh: Mesh) -> None:
    mesh.start()
    mesh.serve("--plan", "/plan", "--busy-s", "0.2")
    mesh.wait_carried("/plan")
    calls = mesh.call("/plan", "--count", "40", "--timeout-s", "8")
    wait_until(lambda: mesh.cloud.stats.requests_sent[PLAN] == 40, "all at the bridge")
    for execution in tuple(mesh.link.executions):
        mesh.cloud.handle(CancelExecution(execution, ROBOT))
    result = mesh.result(calls)
    refused = mesh.cloud.stats.refused[PLAN, "cancelled"]
    assert refused >= 20
    assert result["answered"] == 40 - refused
    assert {reason for reason, _ in mesh.link.refusals} == {RejectReason.CANCELLED}
    wait_until(lambda: not mesh.cloud.stats.pending, "empty tables")
    assert mesh.cloud.stats.requests_sent[PLAN] == 40
    assert mesh.result(mesh.call("/plan", "--count", "3"))["answered"] == 3


@pytest.mark.audit("dp-10")
def test_who_is_given_up_learns_whether_the_server_got_it(mesh: Mesh) -> None:
    mesh.start()
    mesh.serve("--plan", "/plan", "--busy-s", "0.2")
    mesh.wait_carried("/plan")
    calls = mesh.call("/plan", "--count", "40", "--timeout-s", "8")
    wait_until(lambda: mesh.cloud.stats.requests_sent[PLAN] == 40, "all at the bridge")
    for execution in tuple(mesh.link.executions):
        mesh.cloud.handle(AbandonExecution(execution, ROBOT, awaited=True))
    answered = mesh.result(calls)["answered"]
    reasons = Counter(reason for reason, _ in mesh.link.refusals)
    assert set(reasons) == {RejectReason.OVERLOADED, RejectReason.SERVER_LOST}
    assert reasons[RejectReason.OVERLOADED] >= 20
    assert answered == 40 - reasons.total()
    wait_until(lambda: not mesh.cloud.stats.pending, "empty tables")
    assert mesh.result(mesh.call("/plan", "--count", "3"))["answered"] == 3


def test_a_server_that_answers_nothing_at_first(mesh: Mesh) -> None:
    """More requests than the window are ignored; those behind them are answered all the same, after a silence."""
    mesh.start()
    mesh.serve("--plan", "/plan", "--deep")
    mesh.wait_carried("/plan")
    ignored = ["-1"] * 2
    result = mesh.result(mesh.call("/plan", "--count", "24", "--tolerance", *ignored, *["0"] * 22, "--timeout-s", "12"))
    assert sorted(result["order"]) == list(range(2, 24))
    assert mesh.cloud.stats.requests_paced > 0


@pytest.mark.audit("dp-3")
def test_a_server_that_ignores_a_full_queue_gets_more_when_nobody_waits_for_those(mesh: Mesh) -> None:
    mesh.faults.lifetime_s = 4.0
    mesh.start()
    mesh.serve("--plan", "/plan")
    mesh.wait_carried("/plan")
    assert mesh.result(mesh.call("/plan", "--count", "12", "--tolerance", "-1", "--timeout-s", "6"))["answered"] == 0
    assert mesh.result(mesh.call("/plan", "--count", "12", "--timeout-s", "6"))["answered"] == 12


def test_the_server_ends_with_requests_pending(mesh: Mesh) -> None:
    mesh.start()
    server = mesh.serve("--plan", "/plan")
    mesh.wait_carried("/plan")
    app = mesh.call("/plan", "--count", "30", "--tolerance", "-1", "--timeout-s", "5")
    wait_until(lambda: mesh.cloud.stats.pending == 30, "30 requests in the cloud")
    server.stop(signal.SIGTERM)
    wait_until(lambda: len(mesh.link.refusals) == 30, "30 refusals")
    reasons = [reason for reason, _ in mesh.link.refusals]
    # Those that had been given to the server may have run; the others certainly have not.
    assert set(reasons) == {RejectReason.SERVER_LOST, RejectReason.NOT_OFFERED}
    assert mesh.result(app)["answered"] == 0
    mesh.wait_carried()
    assert mesh.robot.stats.pending == mesh.cloud.stats.pending == 0


def test_a_service_comes_goes_and_comes_back(mesh: Mesh) -> None:
    mesh.start()
    for round_number in range(3):
        server = mesh.serve("--plan", "/plan", "--negate", "/negate")
        mesh.wait_carried("/plan", "/negate")
        assert mesh.result(mesh.call("/plan", "--count", "5"))["answered"] == 5, f"round {round_number}"
        server.stop(signal.SIGTERM)
        mesh.wait_carried()
    assert mesh.robot.stats.answers_sent[PLAN] == 15


def test_a_server_restarted_between_two_scans(mesh: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    """The name never leaves the graph: only the server's endpoint tells that the old requests are lost."""
    monkeypatch.setattr(
        "plr.sidecar.ros.cloud.server_processes.ServerProcesses.watch", lambda _processes, _endpoint: None
    )
    mesh.start()
    old = mesh.serve("--plan", "/plan")
    mesh.wait_carried("/plan")
    mesh.call("/plan", "--count", "4", "--tolerance", "-1", "--timeout-s", "1")
    wait_until(lambda: mesh.cloud.stats.pending == 4, "4 requests at the server")
    with monkeypatch.context() as blind:
        blind.setattr("plr.sidecar.ros.graph.scans.Scans.turn", lambda _scans, _now: None)
        blind.setattr("plr.sidecar.ros.graph.scans.Scans.next_due", lambda _scans: time.monotonic() + 0.1)
        old.stop(signal.SIGTERM)
        mesh.serve("--plan", "/plan")
        node = mesh.cloud._loop.node  # type: ignore[union-attr]  # a started bridge has one
        wait_until(
            lambda: (
                [list(one.values()) for one in graph.server_endpoints(node, PLAN, no_name, 0.0).values()] == [[True]]
            ),
            "only the new one",
        )
    wait_until(lambda: len(mesh.link.refusals) == 4, "refusals")
    # What still stood in the window may have been told before: on a busy machine the new one takes seconds to come up.
    told = set(mesh.link.refusals)
    assert (RejectReason.SERVER_LOST, "the server was replaced") in told
    assert {reason for reason, _ in told} <= {RejectReason.SERVER_LOST, RejectReason.NOT_OFFERED}
    assert mesh.result(mesh.call("/plan"))["answered"] == 1


def test_bytes_that_are_no_request(mesh: Mesh, caplog: pytest.LogCaptureFixture) -> None:
    mesh.start()
    mesh.serve("--plan", "/plan")
    mesh.wait_carried("/plan")
    mesh.faults.mangle_request = lambda payload: payload[:9]
    assert mesh.result(mesh.call("/plan", "--count", "50", "--timeout-s", "3"))["answered"] == 0
    assert [reason for reason, _ in mesh.link.refusals] == [RejectReason.BAD_PAYLOAD] * 50
    assert mesh.cloud.stats.refused == {("/plan", "bad_payload"): 50}
    assert len([record for record in caplog.records if "bad_payload" in record.getMessage()]) < 5
    mesh.faults.mangle_request = lambda payload: payload
    assert mesh.result(mesh.call("/plan"))["answered"] == 1


def test_bytes_that_are_no_response(mesh: Mesh) -> None:
    mesh.start()
    mesh.serve("--plan", "/plan")
    mesh.wait_carried("/plan")
    mesh.faults.mangle_response = lambda payload: os.urandom(7)
    assert mesh.result(mesh.call("/plan", "--count", "5", "--timeout-s", "2"))["answered"] == 0
    assert mesh.robot.stats.unanswered == {("/plan", "failed"): 5}
    assert mesh.robot.stats.pending == 0


def test_withdrawn_with_requests_in_flight(mesh: Mesh) -> None:
    """Late responses to a withdrawn service are counted, and the service can come back meanwhile."""
    mesh.faults.delay_s = lambda: 0.5
    mesh.start()
    mesh.serve("--plan", "/plan", "--deep")
    mesh.wait_carried("/plan")
    app = mesh.call("/plan", "--count", "10", "--timeout-s", "4")
    wait_until(lambda: mesh.robot.stats.pending == 10, "10 requests on their way")
    offers = mesh.link.offers
    mesh.link.offered(())
    mesh.wait_carried()
    mesh.link.offered(offers)
    mesh.wait_carried("/plan")
    assert mesh.result(app)["answered"] == 0
    assert mesh.robot.stats.unanswered == {("/plan", "withdrawn"): 10}
    assert mesh.robot.stats.dropped == {"response_without_request": 10}
    assert mesh.result(mesh.call("/plan"))["answered"] == 1


def test_missed_deadlines_and_failures_are_published(mesh: Mesh, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING, "plr.sidecar")
    mesh.faults.deadline_s = 0.2
    mesh.faults.lifetime_s = 1.0
    mesh.start()
    mesh.serve("--plan", "/plan")
    mesh.wait_carried("/plan")
    with NoticeListener(mesh.robot_domain) as listener:
        wait_until(listener.is_matched, "the notices' publisher")
        time.sleep(0.5)  # matched on this side is not yet matched on the other
        app = mesh.call("/plan", "--count", "2", "--tolerance", "-1", "0", "--timeout-s", "2")
        assert mesh.result(app)["answered"] == 1
        wait_until(lambda: listener.failures, "a failure")
        (missed,) = listener.deadlines
        (failed,) = listener.failures
    assert missed.header.stamp.sec > 0
    (status,) = missed.status
    values = {pair.key: pair.value for pair in status.values}
    assert (status.name, status.hardware_id) == ("/plan", "robot-1")
    assert "200 ms" in status.message
    assert values["deadline_s"] == "0.2"
    assert values["copy_0"] == "lo-test -> cloud"
    assert len(bytes.fromhex(values["request_id"])) == 16
    assert {pair.key: pair.value for pair in failed.status[0].values}["outcome"] == "failed"
    assert mesh.robot.stats.deadlines_missed == {"/plan": 1}
    assert any("deadline of 200 ms missed" in record.getMessage() for record in caplog.records)


def test_an_application_that_is_gone_holds_up_nobody(mesh: Mesh) -> None:
    """Its answers come to nothing; another application's are as quick as ever."""
    mesh.faults.delay_s = lambda: 0.5
    mesh.start()
    mesh.serve("--plan", "/plan", "--deep")
    mesh.wait_carried("/plan")
    for number, end in enumerate((signal.SIGTERM, signal.SIGKILL)):
        gone = mesh.call("/plan", "--count", "50", "--timeout-s", "30")
        wait_until(lambda: mesh.robot.stats.pending == 50, "50 requests on their way")
        gone.stop(end)
        staying = mesh.call("/plan", "--count", "5", "--first", "100")
        assert mesh.result(staying)["answered"] == 5
        wait_until(lambda: not mesh.robot.stats.pending, "an empty table")
        assert mesh.robot.stats.answers_sent[PLAN] == 55 * (number + 1)


def test_a_request_expires_while_it_waits_for_a_slow_server(mesh: Mesh) -> None:
    mesh.faults.lifetime_s = 1.0
    mesh.start()
    mesh.serve("--plan", "/plan", "--busy-s", "0.3")
    mesh.wait_carried("/plan")
    result = mesh.result(mesh.call("/plan", "--count", "20", "--timeout-s", "4"))
    assert 1 <= result["answered"] <= 4
    wait_until(lambda: not mesh.cloud.stats.pending, "an empty table")
    assert not mesh.robot.stats.pending
