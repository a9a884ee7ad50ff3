"""Certificates that end while sessions live: peers part with them; a renewed one is told without a control plane."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from plr.protos.trust.identity import EXPIRED, CertificateError
from plr.sidecar.core.seam.links import SetCredential
from tests.sim.test_sealing import pair

if TYPE_CHECKING:
    from lab.simulated.mesh import Mesh, Node
    from plr.protos.trust.credential import SessionCredential

pytestmark = pytest.mark.audit("sec-6")

ENDS_AFTER_S = 60.0


def judged_in_time(mesh: Mesh, cloud: Node) -> None:
    """The cloud's peers' first certificates end after a minute; renewed ones are good for an hour."""
    end = mesh.now + ENDS_AFTER_S

    def judge(credential: SessionCredential) -> float:
        ends_at = end + 3600.0 if credential.certificate == b"renewed" else end
        if mesh.now > ends_at:
            raise CertificateError(EXPIRED, f"expired {mesh.now - ends_at:.0f} s ago")
        return ends_at

    cloud.own._verify = judge
    cloud.own.forget_admitted()
    cloud.engine.recheck_peers([], mesh.now)
    mesh.pump(cloud)


def look_at_the_clock(mesh: Mesh, cloud: Node) -> None:
    """What the data plane does every second."""
    if cloud.own.forget_ended(mesh.now):
        cloud.engine.recheck_peers([], mesh.now)
        mesh.pump(cloud)


def call(mesh: Mesh, robot: Node, cloud: Node, seconds: int) -> int:
    """A request a second; returns how many were answered."""
    before = len(robot.responses())
    for _ in range(seconds):
        robot.submit(b"x")
        mesh.run(1.0)
        look_at_the_clock(mesh, cloud)
    return len(robot.responses()) - before


def test_a_living_session_ends_with_its_certificate() -> None:
    """Before: 550 of 550 requests were answered after the certificate's end."""
    mesh, robot, cloud = pair()
    judged_in_time(mesh, cloud)
    assert call(mesh, robot, cloud, 50) == 50
    mesh.run(11.0)
    look_at_the_clock(mesh, cloud)
    executed = len(cloud.executed)
    assert call(mesh, robot, cloud, 30) == 0
    assert len(cloud.executed) == executed
    assert set(cloud.engine.peers.refused) == {robot.name}


def test_a_certificate_renewed_in_time_costs_nothing_though_no_control_plane_tells_of_it() -> None:
    mesh, robot, cloud = pair()
    judged_in_time(mesh, cloud)
    assert call(mesh, robot, cloud, 30) == 30
    robot.own.renew(replace(robot.own.credential, certificate=b"renewed"))
    for link in robot.links.values():
        link.execute(SetCredential(robot.own.credential.encode()), mesh.now)
    mesh.pump(robot)
    assert call(mesh, robot, cloud, 120) == 120
    known = cloud.engine.peers.get(robot.name)
    assert known is not None
    assert known.credential == robot.own.credential.encode()
    introduced = [path.renewed_at for link in robot.links.values() for path in link._paths.values()]
    assert introduced == [None, None], "both paths were answered, and say it no more"
