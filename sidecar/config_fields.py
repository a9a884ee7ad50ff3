"""The kinds of names and globs that the sidecar's configuration holds."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import AfterValidator

_NODE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}")
_INTERFACE = re.compile(r"[^\s/]{1,15}")
_INTERFACE_GLOB = re.compile(r"[^\s/]{1,64}")
_SERVICE = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_SERVICE_GLOB = re.compile(r"[/*?\[][A-Za-z0-9_/*?\[\]!-]*")
_GLOB_CHARACTERS = frozenset("*?[")
_MAX_SERVICE_CHARACTERS = 255


def is_glob(pattern: str) -> bool:
    """Whether the text is a pattern rather than a name."""
    return not _GLOB_CHARACTERS.isdisjoint(pattern)


def _check_node_name(text: str) -> str:
    if not _NODE_NAME.fullmatch(text):
        raise ValueError(f"expected 1 to 63 letters, digits, '-', '_' or '.', a letter or digit first, got {text!r}")
    return text


def _check_interface(text: str) -> str:
    if not (_INTERFACE_GLOB if is_glob(text) else _INTERFACE).fullmatch(text):
        raise ValueError(f"expected an interface name of at most 15 characters, or a glob such as wl*, got {text!r}")
    return text


def _check_service(text: str) -> str:
    pattern = _SERVICE_GLOB if is_glob(text) else _SERVICE
    if len(text) > _MAX_SERVICE_CHARACTERS or not pattern.fullmatch(text):
        raise ValueError(f"expected a service name such as /plan_path or a glob such as /arm/*, got {text!r}")
    return text


SidecarName = Annotated[str, AfterValidator(_check_node_name)]
InterfacePattern = Annotated[str, AfterValidator(_check_interface)]
ServicePattern = Annotated[str, AfterValidator(_check_service)]
