"""How the requests that a robot does not even send end."""

from __future__ import annotations

import pytest

from plr.protos.model.ids import Role, ServiceName
from plr.sidecar.core.engine.engine import WrongRoleError
from plr.sidecar.core.robot import request_table
from plr.sidecar.core.seam.application import RequestFailed
from plr.sidecar.core.wire.messages import MAX_PAYLOAD_BYTES
from tests.support.builders import ECHO, A, request_id
from tests.unit.sidecar.core.engine.test_engine import Sidecar

NOBODY = ServiceName("/none")
HUGE = bytes(MAX_PAYLOAD_BYTES + 1)


@pytest.mark.parametrize(
    ("service", "payload", "in_flight"),
    [(NOBODY, b"", 8192), (ECHO, HUGE, 8192), (ECHO, b"", 0)],
    ids=["no offer", "too large", "no room"],
)
def test_every_rejection_is_told_once_and_stands_in_both_books(
    monkeypatch: pytest.MonkeyPatch, service: ServiceName, payload: bytes, in_flight: int
) -> None:
    monkeypatch.setattr(request_table, "MAX_IN_FLIGHT", in_flight)
    sidecar = Sidecar(Role.ROBOT, A)
    sidecar.engine.robot.requests.submit(request_id(1), service, payload, 0.1)
    commands, (failed,) = sidecar.take()
    assert commands == []
    assert isinstance(failed, RequestFailed)
    assert (failed.outcome, failed.service, failed.elapsed_s) == ("rejected", service, 0.0)
    assert sidecar.engine.stats.requests == {(service, "rejected"): 1}
    (told,) = sidecar.engine.take_report(0.2).outcomes
    assert (told.service, told.ok, told.failed) == (service, 0, 1)
    assert sidecar.engine.stats.in_flight == 0


def test_a_robot_runs_no_requests() -> None:
    sidecar = Sidecar(Role.ROBOT, A)
    with pytest.raises(WrongRoleError):
        _ = sidecar.engine.cloud
    assert sidecar.engine.offers() == ()
