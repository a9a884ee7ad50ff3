"""Defines the types that the sections of the sidecar's configuration consist of."""

from __future__ import annotations

import fnmatch
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from pydantic import AfterValidator, BaseModel, Field, PlainValidator, WithJsonSchema

from plr.protos.base.errors import DecodeError
from plr.protos.base.host_port import check_remote
from plr.protos.convert.fields import MAX_MAPPED_COPIES
from plr.protos.model.members import AT_MOST_EVERY_INTERFACE, EVERY_INTERFACE, Copies
from plr.protos.model.names import domain_label, node_name
from plr.protos.program.config_fields import REMOTE_ADDRESS, STRICT, encoded_path, refuse_duplicates, text_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pydantic import GetJsonSchemaHandler
    from pydantic.json_schema import JsonSchemaValue
    from pydantic_core import CoreSchema

    from plr.protos.model.ids import Role

_INTERFACE = re.compile(r"[!-.0-~]{1,15}")
_INTERFACE_GLOB = re.compile(r"[!-.0-~]{1,64}")
_SERVICE = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_SERVICE_TYPE = re.compile(r"[A-Za-z][A-Za-z0-9_]*/srv/[A-Za-z][A-Za-z0-9_]*")
_SERVICE_GLOB = re.compile(r"[/*?\[][A-Za-z0-9_/*?\[\]!-]*")
_GLOB_CHARACTERS = frozenset("*?[")
_MATCHES_NO_NAME = (r"\[", "(?!)")
"""In a translated glob: a bracket that nothing closes, and a range such as [z-a]."""
_MAX_SERVICE_CHARACTERS = 255
MAX_CONTROL_PLANES = 8
"""Maximum number of addresses of the control plane; each is tried over every interface."""
_MAX_SOCKET_BYTES = 101
"""Limit of a unix socket's path, 107 (unix(7)), minus the suffix of the group's socket (sidecar/local/entrance.py)."""
_COPIES_WORDS = {"each": EVERY_INTERFACE, "at_most": AT_MOST_EVERY_INTERFACE}


def _check_local_socket(text: str) -> str:
    if text != "auto" and not (text.startswith("/") and len(encoded_path(text)) <= _MAX_SOCKET_BYTES):
        raise ValueError(f"expected auto, null or an absolute path of at most {_MAX_SOCKET_BYTES} bytes, got {text!r}")
    return text


def is_glob(pattern: str) -> bool:
    """Return whether the text is a pattern rather than a name."""
    return not _GLOB_CHARACTERS.isdisjoint(pattern)


def _check_node_name(text: str) -> str:
    try:
        return node_name(text, "name")
    except DecodeError:
        problem = f"expected 1 to 63 letters, digits, '-', '_' or '.', a letter or digit first, got {text!r}"
        raise ValueError(problem) from None


def _check_interface(text: str) -> str:
    if not (_INTERFACE_GLOB if is_glob(text) else _INTERFACE).fullmatch(text):
        raise ValueError(f"expected an interface name of at most 15 characters, or a glob such as wl*, got {text!r}")
    return text


def _check_service(text: str) -> str:
    pattern = _SERVICE_GLOB if is_glob(text) else _SERVICE
    if len(text) > _MAX_SERVICE_CHARACTERS or not pattern.fullmatch(text):
        raise ValueError(f"expected a service name such as /plan_path or a glob such as /arm/*, got {text!r}")
    if is_glob(text) and any(never in fnmatch.translate(text) for never in _MATCHES_NO_NAME):
        raise ValueError(f"expected brackets such as [ab] or [a-z], got {text!r}")
    return text


def _check_service_type(text: str) -> str:
    if len(text) > _MAX_SERVICE_CHARACTERS or not _SERVICE_TYPE.fullmatch(text):
        raise ValueError(f"expected a type of services such as nav_msgs/srv/GetPlan, got {text!r}")
    return text


def _check_service_name(text: str) -> str:
    if len(text) > _MAX_SERVICE_CHARACTERS or not _SERVICE.fullmatch(text):
        raise ValueError(f"expected a service name such as /plan_locally, got {text!r}")
    return text


def _check_repair_share(value: object) -> float | str:
    if value is False:  # YAML reads an unquoted off as false
        return "off"
    if value in ("off", "auto") and isinstance(value, str):
        return value
    if isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value <= 1:
        return float(value)
    raise ValueError(f"expected off, auto or a number from 0 to 1, got {value!r}")


def _check_domain_label(text: str) -> str:
    try:
        return domain_label(text, "label")
    except DecodeError:
        problem = f"expected 1 to 63 letters, digits, '-', '_', '.', '&' or '+', a letter or digit first, got {text!r}"
        raise ValueError(problem) from None


def _check_control_planes(value: object) -> tuple[str, ...]:
    if isinstance(value, str):
        return (check_remote(value),)
    if isinstance(value, list | tuple) and 1 <= len(value) <= MAX_CONTROL_PLANES:
        if all(isinstance(one, str) for one in value):
            return refuse_duplicates(tuple(check_remote(one) for one in value))
    raise ValueError(f"expected host:port, or a list of 1 to {MAX_CONTROL_PLANES} of them, got {value!r}")


def _check_copies(value: object) -> Copies:
    if isinstance(value, Copies):
        return value
    if isinstance(value, str) and value in _COPIES_WORDS:
        return _COPIES_WORDS[value]
    if isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= MAX_MAPPED_COPIES:
        return Copies(value, value)
    raise ValueError(f"expected each, at_most or a number from 1 to {MAX_MAPPED_COPIES}, got {value!r}")


class Section(BaseModel):
    """A section: checked strictly, then frozen."""

    model_config = STRICT

    def misplaced(self, role: Role) -> Iterator[tuple[str, str]]:
        """Yield each key of the other role that has a value, and why it has no place here."""
        for key, field in type(self).model_fields.items():
            for mark in field.metadata:
                if isinstance(mark, OnlyOn) and mark.role is not role and key in self.model_fields_set:
                    if getattr(self, key) not in (None, ()):
                        yield key, f"expected on a {mark.role.value} only: {mark.why}"


@dataclass(frozen=True)
class OnlyOn:
    """Marks a key that has an effect in one role only."""

    role: Role
    why: str

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return {**handler(schema), ROLE_IN_SCHEMA: self.role.value}


ROLE_IN_SCHEMA = "x-role"
"""Keyword of the JSON Schema for the only role in which a key has an effect."""

_LABEL = "1 to 63 letters, digits, `-`, `_`, `.`, `&`, `+`"

SidecarName = Annotated[
    str, AfterValidator(_check_node_name), text_of("1 to 63 letters, digits, `-`, `_`, `.`, a letter or digit first")
]
InterfacePattern = Annotated[str, AfterValidator(_check_interface), text_of("name or glob")]
ServicePattern = Annotated[str, AfterValidator(_check_service), text_of("full name or glob")]
ServiceType = Annotated[str, AfterValidator(_check_service_type), text_of("name of a type")]
FullServiceName = Annotated[str, AfterValidator(_check_service_name), text_of("full name")]
RepairShare = Annotated[
    float | str,
    PlainValidator(_check_repair_share),
    WithJsonSchema({"anyOf": [{"enum": ["off", "auto"]}, {"type": "number", "minimum": 0, "maximum": 1}]}),
]
ControlPlaneAddresses = Annotated[
    tuple[str, ...],
    PlainValidator(_check_control_planes),
    WithJsonSchema(
        {
            "anyOf": [
                REMOTE_ADDRESS,
                {"type": "array", "items": REMOTE_ADDRESS, "minItems": 1, "maxItems": MAX_CONTROL_PLANES},
            ]
        }
    ),
]
DomainLabel = Annotated[str, Field(min_length=1), AfterValidator(_check_domain_label), text_of(_LABEL)]
"""Name of a region or a carrier."""
LocalSocket = Annotated[
    str,
    AfterValidator(_check_local_socket),
    WithJsonSchema({"anyOf": [{"enum": ["auto"]}, {"type": "string", "format": "absolute path"}]}),
]
CopiesWanted = Annotated[
    Copies,
    PlainValidator(_check_copies),
    WithJsonSchema(
        {"anyOf": [{"enum": [*_COPIES_WORDS]}, {"type": "integer", "minimum": 1, "maximum": MAX_MAPPED_COPIES}]},
    ),
]
