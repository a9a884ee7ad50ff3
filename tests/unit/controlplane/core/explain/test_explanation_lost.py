"""A service whose ROS node ended is explained by the server that lost it."""

from __future__ import annotations

import pytest

from plr.controlplane.core.explain.explanation import UnknownNameError, find
from plr.controlplane.core.policy.permits import Permits
from plr.controlplane.core.registry.registry import Registry
from plr.protos.model.ids import NodeName, Role
from plr.protos.model.members import CandidateSet, ServiceSet
from tests.support.samples import PLAN, interfaces, offer, registration, stream

ROBOT = NodeName("robot")


def said(offering: tuple[str, ...], lost: tuple[str, ...]) -> str:
    members = Registry(lease_s=5.0)
    for number, name in enumerate((ROBOT, *offering, *lost)):
        role = Role.ROBOT if name == ROBOT else Role.CLOUD
        members.register(registration(name, role), stream(number), 0.0)
        members.set_candidates(NodeName(name), CandidateSet(interfaces("eth0")))
        if role is Role.CLOUD:
            members.set_services(NodeName(name), ServiceSet((offer(),)))
    for name in lost:
        members.set_services(NodeName(name), ServiceSet(()))
    with pytest.raises(UnknownNameError) as caught:
        find(members, Permits(None), ROBOT, PLAN)
    return str(caught.value)


def test_the_server_whose_node_is_gone_is_named() -> None:
    assert said((), ("a",)) == (
        f"robot carries no {PLAN}: the ROS node that served it on a is gone, and no other cloud offers it; the sidecar "
        "there runs: start the node again"
    )
    assert "served it on a, b, c and 2 more is gone" in said((), ("a", "b", "c", "d", "e"))


def test_it_is_not_blamed_while_another_server_offers_the_service() -> None:
    assert "although clouds that it may call offer it" in said(("b",), ("a",))
