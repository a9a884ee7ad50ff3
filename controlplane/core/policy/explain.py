"""Explains why a call is allowed or denied, in lines for the operator."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING

from plr.controlplane.core.policy.patterns import matches
from plr.controlplane.core.policy.policy import CallRule, OfferRule

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.controlplane.core.policy.policy import Policy
    from plr.protos.model.ids import NodeName, ServiceName


MAX_NAMED_RULES = 5
"""Number of rules named that all but allow a call, the first ones."""


@dataclass(frozen=True, slots=True)
class Decision:
    """What a policy says about one call."""

    allowed: bool
    reasons: tuple[str, ...]


def explain(policy: Policy | None, robot: NodeName, service: ServiceName, cloud: NodeName) -> Decision:
    """Say which rules decide on a call, or which rule is missing."""
    if policy is None:
        return Decision(True, ("the configuration has no policy, so everything is allowed",))
    reasons = (*_offer_reasons(policy, service, cloud), *_call_reasons(policy, robot, service, cloud))
    return Decision(policy.allows(robot, service, cloud), reasons)


def _offer_reasons(policy: Policy, service: ServiceName, cloud: NodeName) -> Iterator[str]:
    index = policy.offer_rule(cloud, service)
    if index is not None:
        yield f"offers[{index}] lets {cloud} offer {service}: {policy.offers[index]}"
        return
    yield f"no rule lets {cloud} offer {service}; missing under offers: {OfferRule((cloud,), (service,))}"
    close = (
        f"offers[{number}] comes close: {rule}"
        for number, rule in enumerate(policy.offers)
        if matches(cloud, rule.clouds) or matches(service, rule.services)
    )
    yield from islice(close, MAX_NAMED_RULES)


def _call_reasons(policy: Policy, robot: NodeName, service: ServiceName, cloud: NodeName) -> Iterator[str]:
    index = policy.call_rule(robot, service, cloud)
    if index is not None:
        yield f"calls[{index}] lets {robot} call {service} on {cloud}: {policy.calls[index]}"
        return
    yield f"no rule lets {robot} call {service} on {cloud}; missing under calls: " + str(
        CallRule((robot,), (service,), (cloud,))
    )
    close = (
        f"calls[{number}] comes close: {rule}"
        for number, rule in enumerate(policy.calls)
        if matches(robot, rule.robots) + matches(service, rule.services) + matches(cloud, rule.clouds) == 2
    )
    yield from islice(close, MAX_NAMED_RULES)
