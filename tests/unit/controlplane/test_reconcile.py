"""What a sidecar should hold, as pure functions."""

from __future__ import annotations

import pytest

from controlplane.core.picture import BlockNotes, Picture
from controlplane.core.plan import BlockPlan, Plan
from controlplane.core.problem import BlockKey, FleetKey, Problem
from controlplane.core.reconcile import differs, mapping_of, peers_of, removed_peers
from controlplane.core.registry import Registry, Sidecar
from protos.model import (
    Assignment,
    InterfaceName,
    NodeName,
    Peer,
    RemovalReason,
    RemovedPeer,
    Role,
    ServiceMapping,
    ServiceSet,
    ServiceUse,
)
from tests.unit.controlplane.samples import PLAN, interfaces, offer, registration, stream, use

KEY = BlockKey(NodeName("robot"), PLAN)
A, B, C = NodeName("a"), NodeName("b"), NodeName("c")
WLAN, WWAN = InterfaceName("wlan0"), InterfaceName("wwan0")


def robot(*uses: ServiceUse) -> Sidecar:
    return Sidecar(
        registration("robot"), 9.0, stream(1), interfaces("wlan0", "wwan0"), ServiceSet((), uses or (use(),))
    )


def peers(*names: str) -> tuple[Peer, ...]:
    return tuple(
        Sidecar(registration(name, Role.CLOUD), 9.0, stream(2), interfaces("eth0"), ServiceSet((offer(),))).as_peer()
        for name in names
    )


def plan(*pairs: tuple[InterfaceName, NodeName], predicted: float = 0.01, excess: int = 0) -> Plan:
    return Plan({KEY: BlockPlan(KEY, pairs, 0.1, predicted, excess)})


def picture(**notes: object) -> Picture:
    return Picture(Problem(()), {KEY: BlockNotes(**notes)})  # type: ignore[arg-type]  # passed through


def pairs(mapping: ServiceMapping) -> list[tuple[str, str]]:
    return [(assignment.interface, assignment.server) for assignment in mapping.assignments]


def test_peers_are_the_other_role_by_name_when_ready() -> None:
    registry = Registry(lease_s=5.0)
    for number, (name, role) in enumerate(
        [("b", Role.CLOUD), ("a", Role.CLOUD), ("r", Role.ROBOT), ("late", Role.CLOUD)]
    ):
        registry.register(registration(name, role), stream(number), 0.0)
        if name != "late":
            registry.set_candidates(NodeName(name), interfaces("eth0"))
            registry.set_services(NodeName(name), ServiceSet())
    assert [peer.name for peer in peers_of(Role.ROBOT, registry)] == ["a", "b"]
    assert [peer.name for peer in peers_of(Role.CLOUD, registry)] == ["r"]


def test_notices_name_those_known_but_not_listed_with_their_reason() -> None:
    registry = Registry(lease_s=5.0)
    registry.register(registration("a", Role.CLOUD), stream(1), 0.0)
    registry.set_draining(A)
    registry.disconnect(A, stream(1))
    assert removed_peers({A, B, C}, peers("c"), registry) == (
        RemovedPeer(A, RemovalReason.LEFT),
        RemovedPeer(B, RemovalReason.LEASE_EXPIRED),
    )


def test_a_mapping_is_the_plan() -> None:
    (mapping,) = mapping_of(robot(), peers("a", "b"), plan((WLAN, A), (WWAN, B)), picture(servers=(A, B)), ())
    assert pairs(mapping) == [("wlan0", "a"), ("wwan0", "b")]
    assert mapping.predicted_miss == 0.01


def test_a_mapping_names_no_peer_and_no_interface_that_is_not_there() -> None:
    stale = plan((WLAN, A), (WWAN, B), (InterfaceName("usb0"), B))
    (mapping,) = mapping_of(robot(), peers("b"), stale, picture(servers=(A, B)), ())
    assert pairs(mapping) == [("wwan0", "b")]
    (nothing,) = mapping_of(robot(), (), stale, picture(servers=(A, B)), ())
    assert pairs(nothing) == []
    assert nothing.predicted_miss == 1.0


def test_a_use_not_yet_solved_for_is_left_out() -> None:
    found = mapping_of(robot(use(), use("/new")), peers("a"), plan((WLAN, A)), picture(servers=(A,)), ())
    assert [mapping.service for mapping in found] == [PLAN]


def test_a_use_that_nobody_serves_says_why() -> None:
    (mapping,) = mapping_of(robot(), peers("a"), Plan({}), picture(unserved="no live server"), ())
    assert mapping == ServiceMapping(PLAN, (), 1.0, "no live server")


@pytest.mark.parametrize(
    ("before", "expected"),
    [((), "b"), ((Assignment(WWAN, C),), "c"), ((Assignment(WWAN, NodeName("gone")),), "b")],
)
def test_a_dark_interface_keeps_its_server_or_takes_a_free_one(before: tuple[Assignment, ...], expected: str) -> None:
    previous = (ServiceMapping(PLAN, before),)
    dark = picture(servers=(A, B, C), dark=(WWAN,))
    (mapping,) = mapping_of(robot(), peers("a", "b", "c"), plan((WLAN, A)), dark, previous)
    assert pairs(mapping) == [("wlan0", "a"), ("wwan0", expected)]
    assert "standby" in mapping.reason


def test_a_dark_interface_of_what_is_not_idempotent_takes_the_one_server() -> None:
    previous = (ServiceMapping(PLAN, (Assignment(WWAN, B),)),)
    dark = picture(servers=(A, B), dark=(WWAN,))
    (mapping,) = mapping_of(robot(use(idempotent=False)), peers("a", "b"), plan((WLAN, A)), dark, previous)
    assert pairs(mapping) == [("wlan0", "a"), ("wwan0", "a")]


def test_relaxations_stand_in_the_reason() -> None:
    own = plan((WLAN, A), (WWAN, A), excess=1)
    (mapping,) = mapping_of(robot(), peers("a"), own, picture(servers=(A,)), ())
    assert "too few servers: capacity exceeded by 1" in mapping.reason
    fleet = Plan(own.blocks, {FleetKey(A, PLAN): 2, FleetKey(B, PLAN): 5})
    (mapping,) = mapping_of(robot(), peers("a"), fleet, picture(servers=(A,)), ())
    assert "for all robots: capacity exceeded by 2" in mapping.reason


def test_only_a_material_change_is_worth_a_version() -> None:
    base = ServiceMapping(PLAN, (Assignment(WLAN, A),), 0.01, "because")
    assert not differs((base,), (base,))
    assert differs((), (base,))
    assert differs((base,), (ServiceMapping(PLAN, (Assignment(WLAN, B),), 0.01, "because"),))
    assert differs((base,), (ServiceMapping(PLAN, base.assignments, 0.01, "for another reason"),))
    assert not differs((base,), (ServiceMapping(PLAN, base.assignments, 0.015, "because"),))
    assert differs((base,), (ServiceMapping(PLAN, base.assignments, 0.03, "because"),))
    tiny = (ServiceMapping(PLAN, base.assignments, 1e-9, "because"),)
    assert not differs(tiny, (ServiceMapping(PLAN, base.assignments, 1e-6, "because"),))
