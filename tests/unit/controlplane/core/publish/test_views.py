"""Who learns of whom, and of what."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plr.controlplane.core.policy.permits import Permits
from plr.controlplane.core.policy.policy import CallRule, OfferRule, Policy
from plr.controlplane.core.publish.views import KnownPeers, Views
from plr.controlplane.core.registry.registry import Registry, Sidecar
from plr.protos.model.ids import NodeName, Role, ServiceName
from plr.protos.model.members import ALL_CALLS, CallPermit, CandidateSet, RemovalReason, RemovedPeer, ServiceSet
from tests.support.samples import interfaces, offer, registration, stream
from tests.unit.controlplane.policies import CLOUDS, ROBOTS, SERVICES, policies

A, B, C = NodeName("a"), NodeName("b"), NodeName("c")
ROBOT = NodeName("robot")
ONLY_A = Policy((CallRule(("*",), ("/plan",), ("a",)),), (OfferRule(("*",), ("*",)),))


def registry(clouds: dict[str, tuple[str, ...]], robots: tuple[str, ...] = ("robot",)) -> Registry:
    """Registered and ready: clouds with what they offer, and robots."""
    made = Registry(lease_s=5.0)
    roles = [(name, Role.CLOUD) for name in clouds] + [(name, Role.ROBOT) for name in robots]
    for number, (name, role) in enumerate(roles):
        made.register(registration(name, role), stream(number), 0.0)
        made.set_candidates(NodeName(name), CandidateSet(interfaces("eth0")))
        made.set_services(NodeName(name), ServiceSet(tuple(map(offer, clouds.get(name, ())))))
    return made


def of(members: Registry, name: str) -> Sidecar:
    found = members.get(NodeName(name))
    assert found is not None
    return found


def names(views: Views, sidecar: Sidecar) -> list[str]:
    return [peer.name for peer in views.peers_of(sidecar)]


def test_peers_are_the_other_role_by_name_when_ready() -> None:
    members = registry({"b": (), "a": ()})
    members.register(registration("late", Role.CLOUD), stream(9), 0.0)
    views = Views(members, Permits(None), KnownPeers())
    assert names(views, of(members, "robot")) == ["a", "b"]
    assert names(views, of(members, "a")) == ["robot"]
    assert [peer.may_call for peer in views.peers_of(of(members, "a"))] == [ALL_CALLS]


def test_notices_name_those_known_but_not_listed_with_their_reason() -> None:
    members = registry({"a": (), "c": ()})
    members.set_draining(A)
    members.disconnect(A, stream(0))
    views = Views(members, Permits(None), KnownPeers())
    assert views.removed(of(members, "robot"), {A, B, C}) == (
        RemovedPeer(A, RemovalReason.LEFT),
        RemovedPeer(B, RemovalReason.LEASE_EXPIRED),
    )


def test_who_has_nothing_to_call_is_not_announced_and_goes_at_once() -> None:
    members = registry({"a": ("/plan",), "b": ("/plan",)})
    views = Views(members, Permits(ONLY_A), KnownPeers())
    robot = of(members, "robot")
    assert names(views, robot) == ["a"]
    assert names(views, of(members, "b")) == []
    assert views.removed(robot, {A, B}) == (RemovedPeer(B, RemovalReason.FORBIDDEN),)
    assert views.removed(of(members, "b"), {ROBOT}) == (RemovedPeer(ROBOT, RemovalReason.FORBIDDEN),)


def test_offers_that_a_robot_may_not_call_are_not_told() -> None:
    members = registry({"a": ("/plan", "/secret")})
    (peer,) = Views(members, Permits(ONLY_A), KnownPeers()).peers_of(of(members, "robot"))
    assert [offered.name for offered in peer.offers] == ["/plan"]


def test_a_server_that_is_away_costs_no_robot_its_place() -> None:
    """Its cloud offers nothing for a moment; what is in flight must not lose its session over that."""
    members = registry({"a": ("/plan",)})
    members.set_services(A, ServiceSet(()))
    views = Views(members, Permits(ONLY_A), KnownPeers())
    (cloud,) = views.peers_of(of(members, "robot"))
    assert cloud.offers == ()
    (robot,) = views.peers_of(of(members, "a"))
    assert robot.may_call == CallPermit(frozenset({ServiceName("/plan")}))


def test_a_cloud_that_has_offered_nothing_yet_is_not_called_forbidden() -> None:
    members = registry({"a": ()})
    views = Views(members, Permits(ONLY_A), KnownPeers())
    assert views.removed(of(members, "robot"), {A}) == (RemovedPeer(A, RemovalReason.LEASE_EXPIRED),)


def test_permits_follow_the_offers() -> None:
    members = registry({"a": ("/detect",)})
    permits = Permits(ONLY_A)
    assert names(Views(members, permits, KnownPeers()), of(members, "robot")) == []
    members.set_services(A, ServiceSet((offer("/plan"),)))
    assert names(Views(members, permits, KnownPeers()), of(members, "robot")) == ["a"]


@given(policies, st.tuples(*(st.sets(st.sampled_from(SERVICES)).map(tuple) for _ in CLOUDS)))
def test_views_tell_what_is_allowed_and_nothing_else(policy: Policy, offered: tuple[tuple[str, ...], ...]) -> None:
    clouds = dict(zip(CLOUDS, offered, strict=True))
    members = registry(clouds, ROBOTS)
    views = Views(members, Permits(policy), KnownPeers())
    allowed = {
        (robot, service, cloud)
        for robot in ROBOTS
        for cloud in CLOUDS
        for service in clouds[cloud]
        if policy.allows(NodeName(robot), ServiceName(service), NodeName(cloud))
    }
    told_to_robots = {
        (robot, offered.name, peer.name)
        for robot in ROBOTS
        for peer in views.peers_of(of(members, robot))
        for offered in peer.offers
    }
    told_to_clouds = {
        (peer.name, service, cloud)
        for cloud in CLOUDS
        for peer in views.peers_of(of(members, cloud))
        for service in peer.may_call.services
    }
    assert told_to_robots == told_to_clouds == allowed
    for robot in ROBOTS:
        assert set(names(views, of(members, robot))) == {cloud for name, _, cloud in allowed if name == robot}
    for cloud in CLOUDS:
        assert set(names(views, of(members, cloud))) == {robot for robot, _, name in allowed if name == cloud}


@pytest.mark.audit("ops-16")
def test_what_was_made_under_former_policies_goes_and_what_is_as_before_stays() -> None:
    members, known = registry({"a": ("/plan",), "b": ("/plan",)}), KnownPeers()
    robot = of(members, "robot")
    everything = Views(members, Permits(None), known).peers_of(robot)
    (only,) = Views(members, Permits(ONLY_A), known).peers_of(robot)
    again = Views(members, Permits(ONLY_A), known).peers_of(robot)
    assert again == (only,)
    assert again[0] is only, "so that views are compared without a look inside"
    Views(members, Permits(ONLY_A), known)
    Views(members, Permits(ONLY_A), known)
    assert not known._made
    assert not known._former
    assert Views(members, Permits(None), known).peers_of(robot) == everything
