"""Turns the `policy` key of the configuration into the core's rules."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from plr.controlplane.config.pattern_fields import NodePatterns, ServicePatterns
from plr.controlplane.core.policy.policy import MAX_RULES, CallRule, OfferRule, Policy


class CallRuleConfig(BaseModel):
    """These robots may call these services on these clouds."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    robots: NodePatterns = Field(description="Patterns of names of robots.")
    services: ServicePatterns = Field(description="Patterns of full names of services.")
    clouds: NodePatterns = Field(description="Patterns of names of clouds.")


class OfferRuleConfig(BaseModel):
    """These clouds may offer these services."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    clouds: NodePatterns = Field(description="Patterns of names of clouds.")
    services: ServicePatterns = Field(description="Patterns of full names of services.")


class PolicyConfig(BaseModel):
    """What is allowed; everything else is denied."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    calls: tuple[CallRuleConfig, ...] = Field(
        default=(), max_length=MAX_RULES, description="Which robots may call which services on which clouds."
    )
    offers: tuple[OfferRuleConfig, ...] = Field(
        default=(), max_length=MAX_RULES, description="Which clouds may offer which services."
    )

    def policy(self) -> Policy:
        """Return the core's rules."""
        return Policy(
            calls=tuple(CallRule(rule.robots, rule.services, rule.clouds) for rule in self.calls),
            offers=tuple(OfferRule(rule.clouds, rule.services) for rule in self.offers),
        )
