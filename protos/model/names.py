"""Checks names and texts for people; a check returns the value or raises a DecodeError that names the field."""

from __future__ import annotations

import re
from functools import lru_cache

from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import InterfaceName, NodeName, ServiceName

MAX_STRING_BYTES = 255
"""Longest string in UTF-8; 255 is also ROS's limit for topic and service names."""

KEPT_NAMES = 16_384
"""Names remembered as good, of some hundred bytes each: every report of a fleet repeats the same dozen."""

# At most 63 characters: such a name fits a certificate's common name (X.520) and a DNS label (RFC 1035).
_NODE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}")
# A region or a carrier, which appears in reasons and log lines.
_DOMAIN_LABEL = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.&+-]{0,62}")
# What Linux allows in an interface's name (IFNAMSIZ includes the NUL), restricted to printable ASCII.
_INTERFACE_NAME = re.compile(r"[!-.0-~]{1,15}")
# ROS 2: tokens of letters, digits and underscores that do not start with a digit.
_SERVICE_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_TYPE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*/(srv|action|msg)/[A-Za-z][A-Za-z0-9_]*")


def clean_text(text: str) -> str:
    """Return `text` on one line, printable and no longer than `MAX_STRING_BYTES`, fit for an error or a reason."""
    printable = "".join(char if char.isprintable() else " " for char in text)
    return printable.encode("utf-8", "replace")[:MAX_STRING_BYTES].decode("utf-8", "ignore")


def text(value: str, field: str) -> str:
    """Check that a text for people is short and printable, so that it breaks neither a log line nor a terminal."""
    if len(value.encode("utf-8", "replace")) > MAX_STRING_BYTES:
        raise DecodeError(f"{field} is longer than {MAX_STRING_BYTES} bytes")
    if not value.isprintable():
        raise DecodeError(f"{field} has a character that is not printable: {value!a}")
    return value


@lru_cache(KEPT_NAMES)
def _name(value: str, field: str, pattern: re.Pattern[str], expected: str) -> str:
    text(value, field)
    if not pattern.fullmatch(value):
        raise DecodeError(f"{field} {value!a} is not {expected}")
    return value


def node_name(value: str, field: str) -> NodeName:
    """Check the name of a sidecar."""
    return NodeName(
        _name(value, field, _NODE_NAME, "a name of 1 to 63 letters, digits, '_', '.' and '-', a letter or digit first")
    )


def interface_name(value: str, field: str) -> InterfaceName:
    """Check the name of a network interface."""
    return InterfaceName(_name(value, field, _INTERFACE_NAME, "the name of an interface, 1 to 15 characters"))


def domain_label(value: str, field: str) -> str:
    """Check the name of a region or a carrier; empty means unknown."""
    return value and _name(
        value,
        field,
        _DOMAIN_LABEL,
        "a name of 1 to 63 letters, digits, '_', '.', '-', '&' and '+', a letter or digit first",
    )


def service_name(value: str, field: str) -> ServiceName:
    """Check a fully qualified ROS name."""
    return ServiceName(_name(value, field, _SERVICE_NAME, "a fully qualified ROS name such as /plan_path"))


def type_name(value: str, field: str) -> str:
    """Check the name of a ROS type."""
    return _name(value, field, _TYPE_NAME, "a ROS type such as nav_msgs/srv/GetPlan")
