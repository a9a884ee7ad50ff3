"""What a policy allows, and how it explains that."""

from __future__ import annotations

from plr.controlplane.core.policy.explain import MAX_NAMED_RULES, explain
from plr.controlplane.core.policy.policy import CallRule, OfferRule, Policy
from plr.protos.model.ids import NodeName, ServiceName
from plr.protos.model.members import NO_POLICY, POLICY_PENDING

ARM, BASE = NodeName("arm-1"), NodeName("base-1")
A, B = NodeName("cloud-a"), NodeName("cloud-b")
PLAN, GRIP = ServiceName("/plan"), ServiceName("/arm/grip")

POLICY = Policy(
    calls=(CallRule(("arm-*",), ("/arm/*",), ("cloud-a",)), CallRule(("*",), ("/plan",), ("*",))),
    offers=(OfferRule(("cloud-a",), ("/arm/*", "/plan")), OfferRule(("cloud-?",), ("/detect",))),
)


def test_both_a_call_rule_and_an_offer_rule_are_needed() -> None:
    assert POLICY.allows(ARM, GRIP, A)
    assert POLICY.allows(BASE, PLAN, A)
    assert not POLICY.allows(BASE, GRIP, A), "no call rule"
    assert not POLICY.allows(ARM, PLAN, B), "cloud-b may not offer it"


def test_rules_add_up_in_any_order() -> None:
    turned = Policy(POLICY.calls[::-1], POLICY.offers[::-1])
    for robot in (ARM, BASE):
        for service in (PLAN, GRIP):
            for cloud in (A, B):
                assert turned.allows(robot, service, cloud) is POLICY.allows(robot, service, cloud)


def test_an_empty_policy_denies_everything() -> None:
    assert not Policy().allows(ARM, GRIP, A)


def test_fingerprints_tell_policies_apart_and_outlive_a_restart() -> None:
    policies = [
        Policy(),
        POLICY,
        Policy(POLICY.calls),
        Policy(offers=POLICY.offers),
        Policy((CallRule(("a", "b"), ("/s",), ("c",)),)),
        Policy((CallRule(("a",), ("b", "/s"), ("c",)),)),
    ]
    assert len({policy.fingerprint for policy in policies} - {NO_POLICY, POLICY_PENDING}) == len(policies)
    assert Policy().fingerprint == 0xA683096011DB3975


def test_an_allowed_call_names_its_rules() -> None:
    decision = explain(POLICY, ARM, GRIP, A)
    assert decision.allowed
    assert decision.reasons == (
        'offers[0] lets cloud-a offer /arm/grip: {clouds: ["cloud-a"], services: ["/arm/*", "/plan"]}',
        'calls[0] lets arm-1 call /arm/grip on cloud-a: {robots: ["arm-*"], services: ["/arm/*"], clouds: ["cloud-a"]}',
    )


def test_a_denied_call_names_the_rule_that_is_missing_and_those_that_come_close() -> None:
    decision = explain(POLICY, BASE, GRIP, B)
    assert not decision.allowed
    assert decision.reasons == (
        'no rule lets cloud-b offer /arm/grip; missing under offers: {clouds: ["cloud-b"], services: ["/arm/grip"]}',
        'offers[0] comes close: {clouds: ["cloud-a"], services: ["/arm/*", "/plan"]}',
        'offers[1] comes close: {clouds: ["cloud-?"], services: ["/detect"]}',
        "no rule lets base-1 call /arm/grip on cloud-b; missing under calls: "
        '{robots: ["base-1"], services: ["/arm/grip"], clouds: ["cloud-b"]}',
        'calls[1] comes close: {robots: ["*"], services: ["/plan"], clouds: ["*"]}',
    )
    assert (
        'calls[0] comes close: {robots: ["arm-*"], services: ["/arm/*"], clouds: ["cloud-a"]}'
        in explain(POLICY, BASE, GRIP, A).reasons
    )


def test_only_a_few_close_rules_are_named() -> None:
    many = Policy((CallRule(("*",), ("/other",), ("*",)),) * 100, POLICY.offers)
    assert len(explain(many, ARM, GRIP, A).reasons) == 2 + MAX_NAMED_RULES


def test_the_missing_rules_it_names_are_the_ones() -> None:
    fixed = Policy(
        (*POLICY.calls, CallRule((BASE,), (GRIP,), (B,))),
        (*POLICY.offers, OfferRule((B,), (GRIP,))),
    )
    assert explain(fixed, BASE, GRIP, B).allowed


def test_without_a_policy_everything_is_allowed_and_it_says_so() -> None:
    decision = explain(None, BASE, GRIP, B)
    assert decision.allowed
    assert "no policy" in decision.reasons[0]
