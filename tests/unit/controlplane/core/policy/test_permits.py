"""Permits say what the policy says, and look up each name once, however many services a cloud announces."""

from __future__ import annotations

import fnmatch

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plr.controlplane.core.policy import permits as permits_module
from plr.controlplane.core.policy.cut_off import cut_off
from plr.controlplane.core.policy.patterns import Glob, PatternIndex
from plr.controlplane.core.policy.permits import Permits
from plr.controlplane.core.policy.policy import CallRule, OfferRule, Policy
from plr.controlplane.core.registry.registry import Registry
from plr.protos.model.ids import NodeName, Role, ServiceName
from plr.protos.model.members import CandidateSet, ServiceSet
from tests.support.samples import interfaces, offer, registration, stream
from tests.unit.controlplane.policies import CLOUDS, ROBOTS, SERVICES, policies

EVIL = NodeName("evil")
ALL_CALLS_RULE = CallRule(("*",), ("*",), ("*",))
SITES = Policy(
    (ALL_CALLS_RULE,),
    tuple(OfferRule(tuple(f"*-site{n}{letter}" for letter in "abcde"), (f"/s{n}",)) for n in range(1024)),
)
"""More patterns than any cache of compiled ones has room for."""


def members(offers: dict[str, tuple[str, ...]], robots: tuple[str, ...] = ("robot",)) -> Registry:
    made = Registry(lease_s=5.0)
    roles = [(name, Role.CLOUD) for name in offers] + [(name, Role.ROBOT) for name in robots]
    for number, (name, role) in enumerate(roles):
        made.register(registration(name, role), stream(number), 0.0)
        made.set_candidates(NodeName(name), CandidateSet(interfaces("eth0")))
        made.set_services(NodeName(name), ServiceSet(tuple(map(offer, offers.get(name, ())))))
    return made


@pytest.fixture
def looked_up(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names looked up in any index, in order."""
    names: list[str] = []
    matching = PatternIndex.matching

    def note(index: PatternIndex, name: str) -> frozenset[int]:
        names.append(name)
        return matching(index, name)

    monkeypatch.setattr(PatternIndex, "matching", note)
    return names


@pytest.fixture
def compiled(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The patterns compiled, in order."""
    patterns: list[str] = []
    translate = fnmatch.translate

    def note(pattern: str) -> str:
        patterns.append(pattern)
        return translate(pattern)

    monkeypatch.setattr(fnmatch, "translate", note)
    return patterns


@given(policies, st.lists(st.tuples(st.sampled_from(CLOUDS), st.sets(st.sampled_from(SERVICES))), max_size=3))
def test_they_say_what_the_policy_says(policy: Policy, offers: list[tuple[str, set[str]]]) -> None:
    fleet = members({name: tuple(sorted(services)) for name, services in offers}, ROBOTS)
    permits = Permits(policy)
    met: set[str] = set()
    for cloud in fleet:
        if cloud.role is not Role.CLOUD:
            continue
        offered = {one.name for one in cloud.offers}
        for service in map(ServiceName, SERVICES):
            assert permits.may_offer(cloud.name, service) is (policy.offer_rule(cloud.name, service) is not None)
        refused = {name for name in offered if policy.offer_rule(cloud.name, name) is None}
        assert set(permits.refused_offers(cloud)) == refused
        for service in map(ServiceName, SERVICES):
            assert permits.may_offer(cloud.name, service) is (policy.offer_rule(cloud.name, service) is not None)
        for robot in map(NodeName, ROBOTS):
            group = permits.group(robot)
            allowed = {name for name in offered if policy.allows(robot, name, cloud.name)}
            assert {name for name in offered if name in permits.of(group, cloud)} == allowed
            assert permits.may_meet(robot, cloud) is bool(allowed)
            leads = any(rule.concerns(robot) and rule.leads_to(cloud.name) for rule in policy.calls)
            assert permits.may_know(robot, cloud.name) is leads
            met |= {robot, cloud.name} if allowed else set()
    talkative = {one.name for one in fleet if one.role is Role.ROBOT or one.offered}
    somebody = any(one.offered for one in fleet)
    assert cut_off(fleet, permits) == (talkative - met if somebody else frozenset())


def test_a_cloud_is_looked_up_once_whatever_it_announces(looked_up: list[str], compiled: list[str]) -> None:
    permits = Permits(SITES)
    compiled.clear()
    for number in range(4):
        services = tuple(f"/x{number}_{one}" for one in range(100))
        fleet = members({"evil": services})
        cloud = fleet.get(EVIL)
        assert cloud is not None
        assert len(permits.refused_offers(cloud)) == len(services)
        assert not permits.of(permits.group(NodeName("robot")), cloud)
        assert cut_off(fleet, permits) == {"robot", "evil"}
    assert looked_up.count("evil") <= 2, "in the rules for calls and in those for offers"
    assert len(looked_up) <= 2 * 400 + 3, "each service as often as that"
    assert not compiled, "patterns are compiled when the policy is read"


def test_what_was_looked_up_ahead_is_not_looked_up_again(looked_up: list[str]) -> None:
    fleet = members({"evil": ("/a", "/b")}, ("robot", "other"))
    cloud = fleet.get(EVIL)
    assert cloud is not None
    permits = Permits(SITES)
    assert permits.not_looked_up(cloud.offered) == list(cloud.offered)
    assert sum(1 for _ in permits.prepare(fleet)) == 2 + 2 + 1, "a step for each service, for each robot and the cloud"
    assert permits.not_looked_up(cloud.offered) == []
    looked_up.clear()
    cut_off(fleet, permits)
    permits.refused_offers(cloud)
    assert not looked_up
    assert permits.may_offer(EVIL, ServiceName("/a")) is False
    assert not looked_up


def test_patterns_that_a_name_cannot_match_are_not_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[str] = []
    matches = Glob.matches

    def note(glob: Glob, name: str) -> bool:
        tried.append(name)
        return matches(glob, name)

    monkeypatch.setattr(Glob, "matches", note)
    index = PatternIndex([(f"*-site{number}", f"*-?-site{number}", f"a*b*-{number}") for number in range(1000)])
    assert index.matching("a-b-c-site77") == {77}
    assert index.matching("aXbX-77") == {77}
    assert index.matching("a-77") == set()
    assert len(tried) <= 3


def test_names_with_like_rules_share_them_and_room_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    permits = Permits(Policy((ALL_CALLS_RULE, CallRule(("robot-1*",), ("*",), ("*",)))))
    assert permits.group(NodeName("robot-1")) is permits.group(NodeName("robot-12"))
    monkeypatch.setattr(permits_module, "MAX_KEPT_RULES", 3)
    for name in ("a", "robot-1", "b", "robot-12", "c"):
        assert permits.group(NodeName(name)) == ({0, 1} if name.startswith("robot-1") else {0})


def test_without_a_policy_nothing_is_looked_up(looked_up: list[str]) -> None:
    fleet = members({"evil": ("/a",)})
    cloud = fleet.get(EVIL)
    assert cloud is not None
    permits = Permits(None)
    assert list(permits.prepare(fleet)) == []
    assert permits.not_looked_up(cloud.offered) == []
    assert permits.may_offer(EVIL, ServiceName("/a"))
    assert permits.refused_offers(cloud) == ()
    assert not looked_up
