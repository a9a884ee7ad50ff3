"""Parses and checks host:port texts."""

from __future__ import annotations

import re
from ipaddress import ip_address

_HOST_LABEL = r"[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?"
_HOST = re.compile(rf"(?=.{{1,253}}$){_HOST_LABEL}(\.{_HOST_LABEL})*")
_PORT = re.compile(r"[0-9]{1,5}")
_MAX_PORT = 65535
_UNSPECIFIED = ("0.0.0.0", "::")  # noqa: S104 - refused, not listened on


def split_host_port(text: str) -> tuple[str, int]:
    """Split host:port (name, IPv4, or IPv6 in brackets); raise a ValueError that says what was expected."""
    if "//" in text:
        raise ValueError(f"expected host:port without {text.partition('//')[0]}//, got {text!r}")
    host, _, port = text.rpartition(":")
    if not host or not _PORT.fullmatch(port) or int(port) > _MAX_PORT:
        raise ValueError(f"expected host:port with a port up to {_MAX_PORT}, got {text!r}")
    if host.startswith("[") and host.endswith("]"):
        return canonical_ip(host[1:-1]), int(port)
    if ":" in host:
        raise ValueError(f"expected an IPv6 address in brackets, as in [2001:db8::1]:50051, got {text!r}")
    if not _HOST.fullmatch(host):
        raise ValueError(f"expected host:port with a host name or IP address, got {text!r}")
    # Resolvers take 1 for 0.0.0.1 and 010 for 8; no host name ends in a number (RFC 3696 section 2).
    if host.rpartition(".")[2].isdigit():
        canonical_ip(host)
    return host, int(port)


def canonical_ip(text: str) -> str:
    """Return an IPv4 or IPv6 address in canonical form; raise a ValueError that says what was expected."""
    try:
        address = ip_address(text)
    except ValueError:
        raise ValueError(f"expected an IP address, got {text!r}") from None
    if "%" in text:
        raise ValueError(f"expected an IP address without a zone, got {text!r}")
    return str(address)


def check_remote(text: str) -> str:
    """Check host:port of a server to connect to; raise a ValueError that says what was expected."""
    host, port = split_host_port(text)
    if port == 0:
        raise ValueError(f"expected host:port with a port from 1 to {_MAX_PORT}, got {text!r}")
    if host in _UNSPECIFIED:
        raise ValueError(f"expected an address that can be reached, got {text!r}")
    address = numeric_host(text)
    if address is not None and ip_address(address[0]).is_multicast:
        raise ValueError(f"expected the address of one host, not of a multicast group, got {text!r}")
    return text


def numeric_host(host_port: str) -> tuple[str, int] | None:
    """Return the address in host:port, already checked; None if it is a name."""
    host, port = split_host_port(host_port)
    try:
        return canonical_ip(host), port
    except ValueError:
        return None


def is_loopback(host_port: str) -> bool:
    """Return whether host:port, already checked, is on this machine; a name other than localhost may lead anywhere."""
    host, _ = split_host_port(host_port)
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
