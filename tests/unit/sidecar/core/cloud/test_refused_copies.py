"""Copies that were refused unrun, and stay refused."""

from __future__ import annotations

import pytest

from plr.protos.model.ids import NodeName
from plr.sidecar.core.base.values import RejectReason
from plr.sidecar.core.cloud import refused_copies
from plr.sidecar.core.cloud.executions import MIN_REMEMBER_S, Reply, ReplyTo
from plr.sidecar.core.cloud.refused_copies import RefusedCopies, RefusedCopy
from plr.sidecar.core.seam.stats import EngineStats
from plr.sidecar.core.wire.messages import RejectionMessage
from tests.support.builders import request, request_id
from tests.unit.sidecar.core.cloud.test_executions import ROBOT, ROBOT_2ND, run, table


@pytest.mark.audit("dp-14")
@pytest.mark.parametrize("by_application", [True, False])
def test_a_copy_that_was_refused_does_not_run_later_and_another_one_does(by_application: bool) -> None:
    executions = table()
    if by_application:
        execution = run(executions, request())
        executions.on_request(ROBOT_2ND, request(copy=1), 1.0)
        replies = executions.refuse(execution.execution, RejectReason.OVERLOADED, "too much", 1.0)
    else:
        replies = [
            executions.refuse_unseen(ReplyTo(ROBOT, copy), request(copy=copy), RejectReason.OVERLOADED, "too much", 1.0)
            for copy in (0, 1)
        ]
    for reply in replies:
        again = executions.on_request(ROBOT_2ND, request(copy=reply.to.copy), 2.0)
        assert isinstance(again, Reply)
        assert again.message == reply.message
        assert isinstance(again.message, RejectionMessage)
    run(executions, request(copy=2), 2.0)


def test_they_are_forgotten_when_they_cannot_come_any_more() -> None:
    executions = table()
    executions.refuse_unseen(ReplyTo(ROBOT, 0), request(lifetime_s=200.0), RejectReason.DRAINING, "", 1.0)
    executions.refuse_unseen(ReplyTo(ROBOT, 0), request(2), RejectReason.DRAINING, "", 1.0)
    run(executions, request(2), 1.0 + MIN_REMEMBER_S)
    assert isinstance(executions.on_request(ROBOT, request(), 200.0), Reply)


def test_they_are_capped_and_shared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(refused_copies, "MAX_REFUSED_COPIES", 20)
    stats = EngineStats()
    refused = RefusedCopies(stats)
    for number in range(30):
        for _ in range(2):
            copy = RefusedCopy(NodeName("robot"), request_id(number), 0)
            refused.add(copy, RejectReason.DRAINING, "", 9.0, 1.0)
    assert (len(refused), stats.dropped["refused_copies_full"]) == (10, 40)
    other = RefusedCopy(NodeName("other"), request_id(1), 0)
    refused.add(other, RejectReason.OVERLOADED, "why", 9.0, 1.0)
    assert refused.why(other, 8.9) == (RejectReason.OVERLOADED, "why")
    assert refused.why(other, 9.0) is None
    assert len(refused) == 0
