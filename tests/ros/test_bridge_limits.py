"""Every table of the bridge has a cap: what does not fit is counted and refused, the rest goes on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from plr.protos.model.ids import NodeName, ServiceName, SessionId
from plr.sidecar.core.base.values import RejectReason
from plr.sidecar.core.rules.service_rule import ServiceRule
from plr.sidecar.core.seam.application import OfferService
from plr.sidecar.ros.rcl import RmwRequestId
from plr.sidecar.ros.robot.request_numbering import RequestNumbering
from tests.ros.mesh import wait_until

if TYPE_CHECKING:
    from tests.ros.mesh import Mesh

pytestmark = pytest.mark.ros

PLAN = ServiceName("/plan")


def test_more_requests_than_a_robot_may_have_pending(mesh: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("plr.sidecar.ros.robot.robot_side.MAX_PENDING_REQUESTS", 10)
    mesh.faults.delay_s = lambda: 0.5
    mesh.start()
    mesh.serve("--plan", "/plan")
    mesh.wait_carried("/plan")
    result = mesh.result(mesh.call("/plan", "--count", "30", "--timeout-s", "3"))
    assert result["order"] == list(range(10))
    assert mesh.robot.stats.unanswered == {(PLAN, "too_many_pending"): 20}
    assert mesh.result(mesh.call("/plan", "--count", "5"))["answered"] == 5


def test_more_requests_than_a_server_may_have(mesh: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("plr.sidecar.ros.cloud.cloud_side.MAX_PENDING_CALLS", 20)
    mesh.start()
    mesh.serve("--plan", "/plan")
    mesh.wait_carried("/plan")
    result = mesh.result(mesh.call("/plan", "--count", "30", "--tolerance", "0.5", "--timeout-s", "4"))
    assert result["answered"] == 10
    assert [reason for reason, _ in mesh.link.refusals] == [RejectReason.OVERLOADED] * 20
    assert mesh.cloud.stats.refused == {(PLAN, "overloaded"): 20}


def test_a_robot_that_fills_its_share_leaves_the_others_theirs(mesh: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its requests lie at a slow server; the other robot asks another one, which is idle."""
    monkeypatch.setattr("plr.sidecar.ros.cloud.cloud_side.MAX_PENDING_CALLS", 20)
    mesh.start()
    mesh.serve("--plan", "/plan")
    mesh.serve("--plan", "/slow", "--busy-s", "0.5")
    mesh.wait_carried("/plan", "/slow")
    greedy = mesh.call("/slow", "--count", "100", "--timeout-s", "20")
    slow, stats = ServiceName("/slow"), mesh.cloud.stats
    wait_until(
        lambda: stats.requests_sent[slow] + stats.refused[slow, "overloaded"] >= 100,
        "all of them to be here or refused",
    )
    assert stats.refused[slow, "overloaded"]
    mesh.link.asker = NodeName("another")
    assert mesh.result(mesh.call("/plan", "--count", "5"))["answered"] == 5
    assert mesh.result(greedy)["answered"] <= 20


def test_an_offer_that_no_rule_carries(mesh: Mesh) -> None:
    mesh.use_rules(ServiceRule("/plan", deadline_s=0.1, lifetime_s=1.0))
    mesh.start()
    for name in ("/plan", "/other", "/node/get_parameters"):
        mesh.robot.handle(OfferService(ServiceName(name), "std_srvs/srv/Empty"))
    mesh.wait_carried("/plan")
    wait_until(lambda: mesh.robot.stats.dropped == {"offer_not_in_rules": 2}, "two offers dropped")


def test_requests_are_never_named_alike() -> None:
    """Not even when rmw repeats a guid and a sequence number, and never as in another session."""
    one, other = RequestNumbering(SessionId(1)), RequestNumbering(SessionId(2))
    again = RmwRequestId((0, 1, 2), 7)
    names = [numbering.identify(again) for numbering in (one, one, other, other)]
    assert len({name for name, _ in names}) == 4
    assert all(len(name) == 16 for name, _ in names)
    assert {client for _, client in names} == {bytes([0, 1, 2]) + bytes(13)}
