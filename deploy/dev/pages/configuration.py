"""Describes the keys of a configuration file in Markdown, by the JSON Schema that `plr config schema` prints."""

from __future__ import annotations

import re
import textwrap
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from deploy.dev.pages.blocks import replace_blocks
from plr.controlplane.config.controlplane import ControlPlaneConfig
from plr.sidecar.config.fields import ROLE_IN_SCHEMA
from plr.sidecar.config.sidecar import SidecarConfig

if TYPE_CHECKING:
    from collections.abc import Iterator

_Schema = dict[str, Any]

SEE = {
    "plr-sidecar": {
        "control_plane": "[how a sidecar reaches it](../start/install.md#how-a-sidecar-reaches-the-control-plane)",
        "services[].deadline_ms": "[what happens on a miss](../start/first-service.md#what-happens-on-a-miss)",
        "services[].redundancy": "[choosing one](redundancy.md#choosing-one)",
        "services[].hedge_quantile": "[when the hedge is sent](redundancy.md#when-the-hedge-is-sent)",
        "services[].repeats": "[when a request is shared](redundancy.md#when-a-request-is-shared)",
        "services[].copies": "[fewer copies](objectives.md#fewer-copies-and-copies-that-do-not-fail-together)",
        "services[].mode": "[the least cost](objectives.md#the-least-cost)",
        "services[].target_miss": "[when an adaptive copy is sent](redundancy.md#when-an-adaptive-copy-is-sent)",
        "services[].fallback": "[a fallback on the robot](fallback.md)",
        "networks": "[choosing what to optimise](objectives.md)",
        "networks[].extra_load": "[budgets](redundancy.md#budgets)",
        "networks[].extra_mb_per_day": "[budgets](redundancy.md#budgets)",
        "max_revocation_age_s": "[demand a fresh list](../start/certificates.md#demand-a-fresh-list)",
        "local_socket": "[the doctor](../operate/doctor.md)",
    },
    "plr-controlplane": {
        "state_dir": "[events](../operate/events.md)",
        "histogram_half_life_s": "[how misses are predicted](../develop/theory.md#epsilon)",
        "paths": "[pairs that may not be used](objectives.md#pairs-that-may-not-be-used)",
        "policy": "[access control](access-control.md)",
    },
}
"""Links to add, by program and key: a schema is read elsewhere, where a relative link leads nowhere."""

_WIDTH = 120
_UNITS = {"_ms": "ms", "_s": "s", "_mb_per_day": "10^6 bytes a day", "_interfaces": "interfaces"}
_CODE = re.compile("`[^`]*`")
_TIED = "\N{NO-BREAK SPACE}"
"""Stands for a space at which no line may end."""
_KINDS = {"boolean": "`true` or `false`", "integer": "whole number", "number": "number", "string": "text"}


def with_keys(page: str) -> str:
    """Return the page of the configuration with the keys of both programs in its blocks."""
    programs = {
        "plr-sidecar": keys_of(SidecarConfig.model_json_schema(), "robot and cloud"),
        "plr-controlplane": keys_of(ControlPlaneConfig.model_json_schema()),
    }
    return replace_blocks(page, {name: described(keys, SEE[name]) for name, keys in programs.items()})


@dataclass(frozen=True)
class Key:
    """A key as the page writes it, such as `services[].deadline_ms`."""

    name: str
    facts: str
    description: str


def keys_of(schema: _Schema, role: str = "") -> list[Key]:
    """Return the keys of a JSON Schema, each followed by those below it; `role`: whose keys, if not all programs'."""
    return list(_keys_below(schema, schema.get("$defs", {}), "", role))


def described(keys: list[Key], see: dict[str, str]) -> str:
    """Return the keys in Markdown; raise ValueError for a link at no key."""
    if unknown := set(see) - {key.name for key in keys}:
        raise ValueError(f"expected links at keys only, got {', '.join(sorted(unknown))}")
    parts = []
    for key in keys:
        level = "###" + "#" * key.name.count(".")
        link = f"\n\nSee {see[key.name]}." if key.name in see else ""
        parts += [f"{level} `{key.name}`", key.facts, *_wrapped(key.description + link)]
    return "\n\n".join(parts) + "\n"


def _keys_below(section: _Schema, definitions: _Schema, prefix: str, role: str) -> Iterator[Key]:
    required = section.get("required", ())
    for name, field in section["properties"].items():
        whose = field.get(ROLE_IN_SCHEMA, role)
        options = [_resolved(option, definitions) for option in field.get("anyOf", [field])]
        if field.get("default", ...) is None:
            options = [option for option in options if option.get("type") != "null"]
        facts = [whose, _kind(name, options, definitions), _default(field, name in required)]
        yield Key(prefix + name, " · ".join(filter(None, facts)), _resolved(field, definitions)["description"])
        for option in options:
            item = _resolved(option.get("items", option), definitions)
            if "properties" in item:
                yield from _keys_below(item, definitions, f"{prefix}{name}{'[]' * ('items' in option)}.", whose)


def _resolved(schema: _Schema, definitions: _Schema) -> _Schema:
    return {**definitions[schema["$ref"].rsplit("/", 1)[-1]], **schema} if "$ref" in schema else schema


def _kind(name: str, options: list[_Schema], definitions: _Schema) -> str:
    unit = next((unit for end, unit in _UNITS.items() if name.endswith(end)), "")
    words = [word for option in options for word in _words(option, unit, definitions)]
    return " or ".join(filter(None, (", ".join(words[:-1]), words[-1])))


def _words(option: _Schema, unit: str, definitions: _Schema) -> Iterator[str]:
    """Yield what a value may be."""
    kind = option.get("type")
    if "enum" in option:
        yield from (f"`{value}`" for value in option["enum"])
    elif kind == "null":
        yield "`null`"
    elif kind == "object":
        yield "section"
    elif kind == "array":
        item = _resolved(option["items"], definitions)
        of = "sections" if "properties" in item else f"{item['format']} entries"
        yield f"list of {of}{_count(option.get('minItems', 0), option.get('maxItems'))}"
    else:
        found = option.get("format") or _KINDS[option["type"]]
        yield (f"{found} ({unit})" if unit else found) + _range(option)


def _count(least: int, most: int | None) -> str:
    if most is None:
        return f" (at least {least})" if least else ""
    return f" ({least} to {most})" if least else f" (at most {most})"


def _range(schema: _Schema) -> str:
    most = schema.get("maximum", schema.get("exclusiveMaximum"))
    if most is None:
        return ""
    if "exclusiveMinimum" not in schema:
        return f" from {_number(schema['minimum'])} to {_number(most)}"
    end = "below" if "exclusiveMaximum" in schema else "up to"
    return f" above {_number(schema['exclusiveMinimum'])} and {end} {_number(most)}"


def _number(value: float) -> str:
    return str(int(value)) if value == int(value) else str(value)


def _default(field: _Schema, required: bool) -> str:
    default = field.get("default")
    if required:
        return "required"
    if default is None or isinstance(default, dict):
        return ""
    if isinstance(default, list):
        return f"default: {', '.join(f'`{item}`' for item in default) or 'empty'}"
    if isinstance(default, bool):
        return f"default: `{str(default).lower()}`"
    return f"default: `{default if isinstance(default, str) else _number(default)}`"


def _wrapped(text: str) -> Iterator[str]:
    """Yield the paragraphs of a docstring, filled; the items of a list stay apart."""
    for paragraph in re.split(r"\n\s*\n", text.strip()):
        items = re.split(r"\n(?=- )", paragraph)
        yield "\n".join(
            textwrap.fill(
                _CODE.sub(lambda code: code[0].replace(" ", _TIED), " ".join(item.split())),
                _WIDTH,
                subsequent_indent="  " if item.startswith("- ") else "",
                break_long_words=False,
                break_on_hyphens=False,
            ).replace(_TIED, " ")
            for item in items
        )
