"""Turns the `policy` key of the configuration into the core's rules."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from plr.controlplane.config.pattern_fields import NodePatterns, ServicePatterns
from plr.controlplane.config.section import Section
from plr.controlplane.core.policy.policy import MAX_RULES, CallRule, OfferRule, Policy


class CallRuleConfig(Section):
    """These robots may call these services on these clouds."""

    robots: NodePatterns
    """Names of robots."""
    services: ServicePatterns
    """Full names of services."""
    clouds: NodePatterns
    """Names of clouds."""


class OfferRuleConfig(Section):
    """These clouds may offer these services."""

    clouds: NodePatterns
    """Names of clouds."""
    services: ServicePatterns
    """Full names of services."""


class PolicyConfig(Section):
    """What is allowed; everything else is denied."""

    calls: Annotated[tuple[CallRuleConfig, ...], Field(max_length=MAX_RULES, strict=False)] = ()
    """Rules that say which robots may call which services on which clouds."""
    offers: Annotated[tuple[OfferRuleConfig, ...], Field(max_length=MAX_RULES, strict=False)] = ()
    """Rules that say which clouds may offer which services."""

    def policy(self) -> Policy:
        """Return the core's rules."""
        return Policy(
            calls=tuple(CallRule(rule.robots, rule.services, rule.clouds) for rule in self.calls),
            offers=tuple(OfferRule(rule.clouds, rule.services) for rule in self.offers),
        )
