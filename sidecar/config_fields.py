"""The kinds of text that the configuration holds: addresses, names, globs."""

from __future__ import annotations

import re
from ipaddress import ip_address
from typing import Annotated

from pydantic import AfterValidator

_NODE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}")
_INTERFACE = re.compile(r"[^\s/]{1,15}")
_INTERFACE_GLOB = re.compile(r"[^\s/]{1,64}")
_SERVICE = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_SERVICE_GLOB = re.compile(r"[/*?\[][A-Za-z0-9_/*?\[\]!-]*")
_HOST_LABEL = r"[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?"
_HOST = re.compile(rf"(?=.{{1,253}}$){_HOST_LABEL}(\.{_HOST_LABEL})*")
_PORT = re.compile(r"[0-9]{1,5}")
_GLOB_CHARACTERS = frozenset("*?[")
_MAX_SERVICE_CHARACTERS = 255
_MAX_PORT = 65535


def is_glob(pattern: str) -> bool:
    """Whether the text is a pattern rather than a name."""
    return not _GLOB_CHARACTERS.isdisjoint(pattern)


def split_host_port(text: str) -> tuple[str, int]:
    """Split host:port (name, IPv4, or IPv6 in brackets); raises ValueError that says what was expected."""
    host, _, port = text.rpartition(":")
    if not host or not _PORT.fullmatch(port) or int(port) > _MAX_PORT:
        raise ValueError(f"expected host:port with a port up to {_MAX_PORT}, got {text!r}")
    if host.startswith("[") and host.endswith("]"):
        return _canonical_ip(host[1:-1]), int(port)
    if ":" in host:
        raise ValueError(f"expected an IPv6 address in brackets, as in [2001:db8::1]:50051, got {text!r}")
    if not _HOST.fullmatch(host):
        raise ValueError(f"expected host:port with a host name or IP address, got {text!r}")
    return host, int(port)


def refuse_duplicates(values: tuple[str, ...]) -> tuple[str, ...]:
    """Return `values`; raises ValueError when one stands there twice."""
    for index, value in enumerate(values):
        if value in values[:index]:
            raise ValueError(f"expected each entry once, got {value!r} twice")
    return values


def _canonical_ip(text: str) -> str:
    try:
        address = ip_address(text)
    except ValueError:
        raise ValueError(f"expected an IP address, got {text!r}") from None
    if "%" in text:
        raise ValueError(f"expected an IP address without a zone, got {text!r}")
    return str(address)


def _check_remote(text: str) -> str:
    if split_host_port(text)[1] == 0:
        raise ValueError(f"expected host:port with a port from 1 to {_MAX_PORT}, got {text!r}")
    return text


def _check_listen(text: str) -> str:
    host, _ = split_host_port(text)
    _canonical_ip(host)
    return text


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


RemoteAddress = Annotated[str, AfterValidator(_check_remote)]
"""host:port to talk to."""

ListenAddress = Annotated[str, AfterValidator(_check_listen)]
"""address:port to listen on, port 0 for any free one."""

IpAddress = Annotated[str, AfterValidator(_canonical_ip)]
"""IPv4 or IPv6 in canonical form."""

SidecarName = Annotated[str, AfterValidator(_check_node_name)]
InterfacePattern = Annotated[str, AfterValidator(_check_interface)]
ServicePattern = Annotated[str, AfterValidator(_check_service)]
