"""The `policy` key of the configuration: lists of patterns, checked, and turned into the core's rules."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from controlplane.core.patterns import MAX_PATTERN_CHARACTERS, NameKind, can_match
from controlplane.core.policy import MAX_PATTERNS, MAX_RULES, CallRule, OfferRule, Policy
from protos.config_fields import refuse_duplicates

_EXAMPLES = {
    NameKind.NODE: "a name of letters, digits, '_', '.' and '-', or a pattern such as arm-*",
    NameKind.SERVICE: "a full name such as /plan_path, or a pattern such as /arm/*",
}


def one_or_list(value: object) -> object:
    """A text may stand for a list of one."""
    return (value,) if isinstance(value, str) else value


def _check(pattern: str, kind: NameKind) -> str:
    if len(pattern) > MAX_PATTERN_CHARACTERS:
        raise ValueError(f"expected at most {MAX_PATTERN_CHARACTERS} characters")
    if not can_match(pattern, kind):
        raise ValueError(f"matches no name that {kind.value} can have: expected {_EXAMPLES[kind]}, got {pattern!r}")
    return pattern


_NodePattern = Annotated[str, AfterValidator(lambda pattern: _check(pattern, NameKind.NODE))]
_ServicePattern = Annotated[str, AfterValidator(lambda pattern: _check(pattern, NameKind.SERVICE))]
_List = (BeforeValidator(one_or_list), AfterValidator(refuse_duplicates), Field(min_length=1, max_length=MAX_PATTERNS))
_NodePatterns = Annotated[tuple[_NodePattern, ...], *_List]
_ServicePatterns = Annotated[tuple[_ServicePattern, ...], *_List]


class CallRuleConfig(BaseModel):
    """These robots may call these services on these clouds."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    robots: _NodePatterns = Field(description="Patterns of names of robots.")
    services: _ServicePatterns = Field(description="Patterns of full names of services.")
    clouds: _NodePatterns = Field(description="Patterns of names of clouds.")


class OfferRuleConfig(BaseModel):
    """These clouds may offer these services."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    clouds: _NodePatterns = Field(description="Patterns of names of clouds.")
    services: _ServicePatterns = Field(description="Patterns of full names of services.")


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
        """The rules as the core has them."""
        return Policy(
            calls=tuple(CallRule(rule.robots, rule.services, rule.clouds) for rule in self.calls),
            offers=tuple(OfferRule(rule.clouds, rule.services) for rule in self.offers),
        )
