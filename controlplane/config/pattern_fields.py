"""Defines the lists of name patterns that several keys of the configuration hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from pydantic import AfterValidator, Field
from pydantic_core import core_schema

from plr.controlplane.core.policy.patterns import MAX_PATTERN_CHARACTERS, NameKind, can_match
from plr.controlplane.core.policy.policy import MAX_PATTERNS
from plr.protos.program.config_fields import refuse_duplicates, text_of

if TYPE_CHECKING:
    from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
    from pydantic.json_schema import JsonSchemaValue
    from pydantic_core import CoreSchema

_EXAMPLES = {
    NameKind.NODE: "a name of letters, digits, '_', '.' and '-', or a pattern such as arm-*",
    NameKind.SERVICE: "a full name such as /plan_path, or a pattern such as /arm/*",
    NameKind.INTERFACE: "a name such as wlan0, or a pattern such as wwan*",
}


@dataclass(frozen=True)
class OneOrList:
    """Takes a single text for a list of one."""

    def __get_pydantic_core_schema__(self, source: object, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_before_validator_function(_as_list, handler(source))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        several = handler(schema)
        return {"anyOf": [several["items"], several]}


def _as_list(value: object) -> object:
    return (value,) if isinstance(value, str) else value


def _check(pattern: str, kind: NameKind) -> str:
    if len(pattern) > MAX_PATTERN_CHARACTERS:
        raise ValueError(f"expected at most {MAX_PATTERN_CHARACTERS} characters")
    if not can_match(pattern, kind):
        raise ValueError(f"matches no name that {kind.value} can have: expected {_EXAMPLES[kind]}, got {pattern!r}")
    return pattern


_PATTERN = text_of("pattern")
_NodePattern = Annotated[str, AfterValidator(lambda pattern: _check(pattern, NameKind.NODE)), _PATTERN]
_ServicePattern = Annotated[str, AfterValidator(lambda pattern: _check(pattern, NameKind.SERVICE)), _PATTERN]
_InterfacePattern = Annotated[str, AfterValidator(lambda pattern: _check(pattern, NameKind.INTERFACE)), _PATTERN]
_List = (Field(min_length=1, max_length=MAX_PATTERNS, strict=False), OneOrList(), AfterValidator(refuse_duplicates))
NodePatterns = Annotated[tuple[_NodePattern, ...], *_List]
ServicePatterns = Annotated[tuple[_ServicePattern, ...], *_List]
InterfacePatterns = Annotated[tuple[_InterfacePattern, ...], *_List]
