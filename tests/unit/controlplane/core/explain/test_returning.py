"""Who does not come back after a restart, and why."""

from __future__ import annotations

import pytest

from plr.controlplane.core.explain.departed import Departure
from plr.controlplane.core.explain.returning import TEXT, Returning
from plr.protos.model.fleet_events import Why
from plr.protos.model.ids import NodeName, Role

NAMES = [NodeName("cloud-1"), NodeName("robot-1"), NodeName("robot-2")]
EXPIRED = "the certificate of robot-1 expired 1 minute ago"


def present(name: NodeName) -> Departure:
    role = Role.CLOUD if name.startswith("cloud") else Role.ROBOT
    return Departure(name, role, Why.LEASE_EXPIRED, 0.0, 0.0, "")


@pytest.mark.audit("ops-11")
def test_who_comes_back_and_is_refused_for_its_certificate_is_not_taken_for_dead() -> None:
    returning = Returning()
    returning.expect(map(present, NAMES), 10.0)
    for name in NAMES[:2]:
        returning.is_refused(name, Why.CERTIFICATE_EXPIRED, EXPIRED)
    returning.is_refused(NodeName("stranger"), Why.REVOKED, "")
    assert returning.missing(9.0, lambda: lambda server: 0) == []
    gone = {one.name: one for one in returning.missing(10.0, lambda: lambda server: 0)}
    assert {name: one.why for name, one in gone.items()} == {
        NAMES[0]: Why.CERTIFICATE_EXPIRED,
        NAMES[1]: Why.CERTIFICATE_EXPIRED,
        NAMES[2]: Why.LEASE_EXPIRED,
    }
    assert EXPIRED in gone[NAMES[1]].text
    assert gone[NAMES[2]].text == TEXT


@pytest.mark.audit("ops-11")
def test_who_is_refused_first_and_registers_then_is_back() -> None:
    returning = Returning()
    returning.expect(map(present, NAMES[:1]), 10.0)
    returning.is_refused(NAMES[0], Why.CERTIFICATE_EXPIRED, EXPIRED)
    returning.is_back(NAMES[0])
    assert returning.missing(10.0, lambda: lambda server: 0) == []
