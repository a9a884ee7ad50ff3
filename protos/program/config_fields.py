"""Defines the fields common to the configurations of both planes: addresses, folders, and how they go together."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, WithJsonSchema

from plr.protos.base.host_port import canonical_ip, check_remote, split_host_port

STRICT = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True)
"""For every section: values have the type that the key asks for, and no key is unknown."""

# A YAML list becomes a tuple, a word an enum or a path; strict mode would refuse these. A list's items stay strict.
converted = Field(strict=False)


def refuse_duplicates(values: tuple[str, ...]) -> tuple[str, ...]:
    """Return `values`; raise ValueError if one occurs twice."""
    for index, value in enumerate(values):
        if value in values[:index]:
            raise ValueError(f"expected each entry once, got {value!r} twice")
    return values


def _check_listen(text: str) -> str:
    host, _ = split_host_port(text)
    canonical_ip(host)
    return text


def check_security(tls_dir: Path | None, insecure: bool) -> None:
    """Check the two keys against each other; raise a ValueError that says what was expected."""
    if tls_dir is None and not insecure:
        raise ValueError("tls_dir: expected the folder with this node's certificate (see: plr ca issue), but missing")
    if tls_dir is not None and insecure:
        raise ValueError("insecure: expected without tls_dir; set one of the two")


def check_absolute(path: Path) -> Path:
    """Return `path`; raise ValueError if it is relative, or no path at all."""
    if not path.is_absolute():
        raise ValueError(f"expected an absolute path, got '{path}'")
    encoded_path(str(path))
    return path


def encoded_path(text: str) -> bytes:
    """Return the path as the system gets it; raise ValueError if nothing can have such a name."""
    try:
        name = os.fsencode(text)
    except UnicodeEncodeError:
        # JSON writes an emoji as two surrogates, which YAML reads as two characters; a locale may have few characters.
        raise ValueError(f"expected a path, got one with characters that names cannot have here: {text!a}") from None
    if b"\0" in name:
        raise ValueError(f"expected a path, got one with a NUL: {text!a}")
    return name


def _refuse_port_alone(value: object) -> object:
    if isinstance(value, int):
        raise ValueError(f"expected address:port, such as [::]:{value} for all addresses, got {value}")
    return value


def text_of(kind: str) -> WithJsonSchema:
    """Describe a text in the JSON Schema by what it has to be, as its `format`."""
    return WithJsonSchema({"type": "string", "format": kind})


REMOTE_ADDRESS = {"type": "string", "format": "host:port"}
"""JSON Schema of an address to connect to."""

AbsolutePath = Annotated[Path, AfterValidator(check_absolute), text_of("absolute path")]
"""A folder; for a service, a relative path would be ambiguous."""

TlsDir = AbsolutePath
"""Folder of a node's certificate files."""

RemoteAddress = Annotated[str, AfterValidator(check_remote), WithJsonSchema(REMOTE_ADDRESS)]
"""host:port to connect to."""

ListenAddress = Annotated[
    str, BeforeValidator(_refuse_port_alone), AfterValidator(_check_listen), text_of("address:port")
]
"""address:port to listen on, port 0 for any free one."""

IpAddress = Annotated[str, AfterValidator(canonical_ip), text_of("IP address")]
"""IPv4 or IPv6 in canonical form."""
