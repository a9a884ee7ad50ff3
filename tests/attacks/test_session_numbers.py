"""A member that registers with the number of a robot's session, which stands in clear in every datagram. Simulated."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from lab.simulated.mesh import Mesh, rule
from lab.simulated.sessions import session_of
from plr.protos.model.ids import Role, Version
from plr.protos.model.members import PeerSet
from plr.protos.trust.credential import session_number
from plr.protos.trust.identity import MALFORMED, CertificateError

if TYPE_CHECKING:
    from plr.protos.trust.credential import SessionCredential

CALLS = 20


@pytest.mark.audit("sec-4")
def test_a_living_robot_keeps_its_session_though_another_registered_with_its_number() -> None:
    """Before: the living paths were dropped, 0 of 20 answered, once the control plane had restarted."""
    mesh = Mesh(1)
    robot, evil, cloud = mesh.robot("wlan0"), mesh.add("evil", Role.ROBOT, ["wlan0"], (rule(),)), mesh.cloud("cloud-a")
    mesh.push_views()
    mesh.run(3)
    taken = session_of("evil", Role.ROBOT, robot.session, evil.incarnation + 5)
    squatter = replace(
        evil.told_to(cloud),
        session=robot.session,
        incarnation=evil.incarnation + 5,
        credential=taken.credential.encode(),
    )

    def judge(credential: SessionCredential) -> float:
        # As `verify` does. The numbers of the simulated sessions are drawn, so only the squatter's is looked at.
        number = session_number(credential.name, credential.role, credential.public_key)
        if credential.name == "evil" and credential.session != number:
            raise CertificateError(MALFORMED, "the credential's session number is not that of its key")
        return math.inf

    cloud.own._verify = judge
    view = PeerSet(Version(mesh.version + 1), mesh.version + 1, (squatter,))
    assert cloud.engine.apply_peers(view, mesh.now) is None
    mesh.pump(cloud)
    for number in range(CALLS):
        robot.submit(b"y%d" % number)
        mesh.run(0.2)
    mesh.run(5)
    assert len(robot.responses()) == CALLS
