"""One name that several nodes serve with different types: only those of the type in use are its servers."""

from __future__ import annotations

import logging
import signal
import time
from typing import TYPE_CHECKING

import pytest

from plr.protos.model.ids import ServiceName
from plr.sidecar.core.base.values import RejectReason
from plr.sidecar.ros.graph import graph
from tests.ros.mesh import no_name, wait_until

if TYPE_CHECKING:
    from tests.ros.mesh import Mesh

pytestmark = pytest.mark.ros

PLAN = ServiceName("/plan")
PLAN_TYPE = "nav_msgs/srv/GetPlan"
OTHER_TYPE = "std_srvs/srv/SetBool"
LEASE_S = 20.0
"""After which DDS itself notices."""


def types_shown(mesh: Mesh) -> set[str]:
    node = mesh.cloud._loop.node  # type: ignore[union-attr]  # a started bridge has one
    return set(graph.server_endpoints(node, PLAN, no_name, 0.0))


def offered(mesh: Mesh) -> dict[str, str]:
    return {offer.name: offer.type for offer in mesh.link.offers}


@pytest.mark.audit("dp-15")
def test_a_stray_of_another_type_hides_no_death(mesh: Mesh, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING, "plr.sidecar")
    mesh.start()
    server = mesh.serve("--plan", "/plan")
    mesh.wait_carried("/plan")
    mesh.serve("--negate", "/plan", "--node", "stray")
    several = f"service /plan is served here with several types, {PLAN_TYPE} (/test_server), {OTHER_TYPE} (/stray): "
    wait_until(
        lambda: [r for r in caplog.records if r.getMessage() == several + f"robots get {PLAN_TYPE}"], "the warning"
    )
    assert offered(mesh) == {PLAN: PLAN_TYPE}
    assert not [r for r in caplog.records if "withdrawn" in r.getMessage()]
    mesh.call("/plan", "--count", "60", "--tolerance", "-1", "--timeout-s", "1")
    wait_until(lambda: mesh.cloud.stats.pending == 60, "60 requests in the cloud")
    killed_at = time.monotonic()
    server.stop(signal.SIGKILL)
    wait_until(lambda: len(mesh.link.refusals) == 60, "60 refusals")
    assert RejectReason.NOT_OFFERED in {reason for reason, _ in mesh.link.refusals}
    wait_until(lambda: offered(mesh) == {PLAN: OTHER_TYPE}, "the stray's type")
    assert types_shown(mesh) == {PLAN_TYPE, OTHER_TYPE}, "DDS noticed by itself: this shows nothing"
    assert time.monotonic() - killed_at < LEASE_S / 2
    assert not [r for r in caplog.records if "servers here" in r.getMessage()]


@pytest.mark.audit("dp-15")
def test_a_killed_server_makes_room_for_one_of_another_type(mesh: Mesh) -> None:
    """Both nodes have one name, of which rmw shows the services of one only."""
    mesh.start()
    first = mesh.serve("--plan", "/plan")
    mesh.wait_carried("/plan")
    first.stop(signal.SIGKILL)
    second = mesh.serve("--negate", "/plan")
    wait_until(lambda: offered(mesh) == {PLAN: OTHER_TYPE}, "the new type")
    assert types_shown(mesh) == {PLAN_TYPE, OTHER_TYPE}, "DDS noticed by itself: this shows nothing"
    second.stop(signal.SIGKILL)
    mesh.serve("--plan", "/plan")
    wait_until(lambda: offered(mesh) == {PLAN: PLAN_TYPE}, "the first type again")
    assert types_shown(mesh) == {PLAN_TYPE, OTHER_TYPE}, "DDS noticed by itself: this shows nothing"
    assert mesh.result(mesh.call("/plan", "--count", "5"))["answered"] == 5
