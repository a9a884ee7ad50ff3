"""What a sidecar should hold, as pure functions."""

from __future__ import annotations

from dataclasses import replace

import pytest

from plr.controlplane.core.formulation.block import BlockNotes, Picture
from plr.controlplane.core.problem.plan import BlockPlan, Plan
from plr.controlplane.core.problem.problem import BlockKey, FleetKey, Problem
from plr.controlplane.core.publish.mappings import differs, mapping_of, reads_differently
from plr.controlplane.core.registry.registry import Sidecar
from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
from plr.protos.model.mapping import Assignment, ServiceMapping
from plr.protos.model.members import ALL_CALLS, CallPermit, Copies, ServiceSet, ServiceUse
from tests.support.samples import PLAN, interfaces, registration, stream, use

KEY = BlockKey(NodeName("robot"), PLAN)
A, B, C = NodeName("a"), NodeName("b"), NodeName("c")
WLAN, WWAN = InterfaceName("wlan0"), InterfaceName("wwan0")


def robot(*uses: ServiceUse) -> Sidecar:
    return Sidecar(registration("robot"), stream(1), interfaces("wlan0", "wwan0"), ServiceSet((), uses or (use(),)))


def servers(*names: str) -> dict[NodeName, CallPermit]:
    return {NodeName(name): ALL_CALLS for name in names}


def plan(*pairs: tuple[InterfaceName, NodeName], predicted: float = 0.01, excess: int = 0) -> Plan:
    return Plan({KEY: BlockPlan(KEY, pairs, 0.1, predicted, excess)})


def picture(**notes: object) -> Picture:
    return Picture(Problem(()), {KEY: BlockNotes(**notes)})  # type: ignore[arg-type]  # passed through


def pairs(mapping: ServiceMapping) -> list[tuple[str, str]]:
    return [(assignment.interface, assignment.server) for assignment in mapping.assignments]


def test_a_mapping_is_the_plan() -> None:
    (mapping,) = mapping_of(robot(), servers("a", "b"), plan((WLAN, A), (WWAN, B)), picture(servers=(A, B)), ())
    assert pairs(mapping) == [("wlan0", "a"), ("wwan0", "b")]
    assert mapping.predicted_miss == 0.01


def test_a_mapping_names_no_peer_and_no_interface_that_is_not_there() -> None:
    stale = plan((WLAN, A), (WWAN, B), (InterfaceName("usb0"), B))
    (mapping,) = mapping_of(robot(), servers("b"), stale, picture(servers=(A, B)), ())
    assert pairs(mapping) == [("wwan0", "b")]
    (nothing,) = mapping_of(robot(), {}, stale, picture(servers=(A, B)), ())
    assert pairs(nothing) == []
    assert nothing.predicted_miss == 1.0


def test_a_mapping_names_no_server_that_the_robot_may_not_call_there() -> None:
    """The plan may be older than the policy."""
    permits = {A: CallPermit(frozenset({ServiceName("/other")})), B: CallPermit(frozenset({PLAN}))}
    (mapping,) = mapping_of(robot(), permits, plan((WLAN, A), (WWAN, B)), picture(servers=(A, B)), ())
    assert pairs(mapping) == [("wwan0", "b")]


def test_a_pair_to_explore_is_told_if_it_is_there_and_not_mapped() -> None:
    def explored(interface: InterfaceName, server: NodeName) -> Assignment | None:
        known = replace(plan((WLAN, A)), explore={KEY: Assignment(interface, server)})
        dark = picture(servers=(A, B), dark=(WWAN,))
        (mapping,) = mapping_of(robot(), servers("a", "b"), known, dark, ())
        assert pairs(mapping) == [("wlan0", "a"), ("wwan0", "b")]
        return mapping.explore

    assert explored(WLAN, B) == Assignment(WLAN, B)
    assert explored(WWAN, B) is explored(WLAN, C) is explored(InterfaceName("usb0"), A) is None


def test_a_use_not_yet_solved_for_is_left_out() -> None:
    found = mapping_of(robot(use(), use("/new")), servers("a"), plan((WLAN, A)), picture(servers=(A,)), ())
    assert [mapping.service for mapping in found] == [PLAN]


def test_a_use_that_nobody_serves_says_why() -> None:
    (mapping,) = mapping_of(robot(), servers("a"), Plan({}), picture(unserved="no live server"), ())
    assert mapping == ServiceMapping(PLAN, (), 1.0, "no live server")


@pytest.mark.parametrize(
    ("before", "expected"),
    [((), "b"), ((Assignment(WWAN, C),), "c"), ((Assignment(WWAN, NodeName("gone")),), "b")],
)
def test_a_dark_interface_keeps_its_server_or_takes_a_free_one(before: tuple[Assignment, ...], expected: str) -> None:
    previous = (ServiceMapping(PLAN, before),)
    dark = picture(servers=(A, B, C), dark=(WWAN,))
    (mapping,) = mapping_of(robot(), servers("a", "b", "c"), plan((WLAN, A)), dark, previous)
    assert pairs(mapping) == [("wlan0", "a"), ("wwan0", expected)]
    assert "standby" in mapping.reason


def test_a_dark_interface_of_what_is_not_idempotent_takes_the_one_server() -> None:
    previous = (ServiceMapping(PLAN, (Assignment(WWAN, B),)),)
    dark = picture(servers=(A, B), dark=(WWAN,))
    (mapping,) = mapping_of(robot(use(idempotent=False)), servers("a", "b"), plan((WLAN, A)), dark, previous)
    assert pairs(mapping) == [("wlan0", "a"), ("wwan0", "a")]


def test_relaxations_stand_in_the_reason() -> None:
    own = plan((WLAN, A), (WWAN, A), excess=1)
    (mapping,) = mapping_of(robot(), servers("a"), own, picture(servers=(A,)), ())
    assert "too few servers: capacity exceeded by 1" in mapping.reason
    fleet = Plan(own.blocks, {FleetKey(A, PLAN): 2, FleetKey(B, PLAN): 5})
    (mapping,) = mapping_of(robot(), servers("a"), fleet, picture(servers=(A,)), ())
    assert "for all robots: capacity exceeded by 2" in mapping.reason


def test_only_a_material_change_is_worth_a_version() -> None:
    base = ServiceMapping(PLAN, (Assignment(WLAN, A),), 0.01, "because")
    assert not differs((base,), (base,))
    assert differs((), (base,))
    assert differs((base,), (ServiceMapping(PLAN, (Assignment(WLAN, B),), 0.01, "because"),))
    assert differs((base,), (replace(base, explore=Assignment(WLAN, B)),))
    unserved = replace(base, assignments=())
    assert differs((unserved,), (replace(unserved, reason="for another reason"),))


def test_what_merely_reads_differently_is_told_apart() -> None:
    base = ServiceMapping(PLAN, (Assignment(WLAN, A),), 0.01, "because")
    tiny = replace(base, predicted_miss=1e-9)
    same = [(base, base), (base, replace(base, predicted_miss=0.015)), (tiny, replace(tiny, predicted_miss=1e-6))]
    other = [(base, replace(base, reason="for another reason")), (base, replace(base, predicted_miss=0.03))]
    assert not any(differs((one,), (another,)) for one, another in same + other)
    assert not any(reads_differently((one,), (another,)) for one, another in same)
    assert all(reads_differently((one,), (another,)) for one, another in other)


def test_where_not_every_interface_is_to_carry_a_copy_none_stands_by_beyond_that() -> None:
    dark = picture(servers=(A, B), dark=(WWAN,))
    one = replace(use(), copies=Copies(1, 1))
    cheap = replace(use(), target_miss=0.01)
    for wish in (one, cheap):
        (mapping,) = mapping_of(robot(wish), servers("a", "b"), plan((WLAN, A)), dark, ())
        assert pairs(mapping) == [("wlan0", "a")]
        assert "standby" not in mapping.reason


def test_the_reason_names_what_copies_share_and_by_how_much_a_target_is_missed() -> None:
    made = replace(plan((WLAN, A)).blocks[KEY], shared=("region eu",), target_miss=0.1, shortfall="misses")
    (mapping,) = mapping_of(robot(), servers("a"), Plan({KEY: made}), picture(servers=(A,)), ())
    assert mapping.reason == "misses; copies share region eu"


def test_a_dark_interface_stands_by_for_no_server_that_it_may_not_be_used_to() -> None:
    dark = picture(servers=(A, B), dark=(WWAN,), barred=frozenset({(WWAN, B)}))
    (mapping,) = mapping_of(robot(), servers("a", "b"), plan((WLAN, A)), dark, ())
    assert pairs(mapping) == [("wlan0", "a"), ("wwan0", "a")]
    single = mapping_of(robot(use(idempotent=False)), servers("a", "b"), plan((WLAN, B)), dark, ())
    assert pairs(single[0]) == [("wlan0", "b")]
