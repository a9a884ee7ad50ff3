"""Defines the lists of name patterns that several keys of the configuration hold."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, BeforeValidator, Field

from plr.controlplane.core.policy.patterns import MAX_PATTERN_CHARACTERS, NameKind, can_match
from plr.controlplane.core.policy.policy import MAX_PATTERNS
from plr.protos.program.config_fields import refuse_duplicates

_EXAMPLES = {
    NameKind.NODE: "a name of letters, digits, '_', '.' and '-', or a pattern such as arm-*",
    NameKind.SERVICE: "a full name such as /plan_path, or a pattern such as /arm/*",
    NameKind.INTERFACE: "a name such as wlan0, or a pattern such as wwan*",
}


def one_or_list(value: object) -> object:
    """Return a list of one for a single text, else the value itself."""
    return (value,) if isinstance(value, str) else value


def _check(pattern: str, kind: NameKind) -> str:
    if len(pattern) > MAX_PATTERN_CHARACTERS:
        raise ValueError(f"expected at most {MAX_PATTERN_CHARACTERS} characters")
    if not can_match(pattern, kind):
        raise ValueError(f"matches no name that {kind.value} can have: expected {_EXAMPLES[kind]}, got {pattern!r}")
    return pattern


_NodePattern = Annotated[str, AfterValidator(lambda pattern: _check(pattern, NameKind.NODE))]
_ServicePattern = Annotated[str, AfterValidator(lambda pattern: _check(pattern, NameKind.SERVICE))]
_InterfacePattern = Annotated[str, AfterValidator(lambda pattern: _check(pattern, NameKind.INTERFACE))]
_List = (BeforeValidator(one_or_list), AfterValidator(refuse_duplicates), Field(min_length=1, max_length=MAX_PATTERNS))
NodePatterns = Annotated[tuple[_NodePattern, ...], *_List]
ServicePatterns = Annotated[tuple[_ServicePattern, ...], *_List]
InterfacePatterns = Annotated[tuple[_InterfacePattern, ...], *_List]
