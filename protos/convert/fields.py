"""Checks single fields against limits; a check returns the value or raises a DecodeError that names the field."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeVar

from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import MAX_VERSION, Version

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence

    from google.protobuf.message import Message

MAX_CANDIDATES = 256
"""Addresses of one sidecar; a dozen interfaces with a handful of IPv6 addresses each stay well below."""

MAX_OFFERS = 1024
"""Services one cloud sidecar offers."""

MAX_USES = 1024
"""Services one robot sidecar carries."""

MAX_REMOVED = 4096
"""Removal notices in one set."""

MAX_ASSIGNMENTS = 256
"""Assignments of one service: as many as a robot can have interfaces."""

MAX_MAPPED_SERVICES = 1024
"""Services in one mapping: as many as a robot can carry."""

MAX_OUTCOMES = 1024
"""Outcome reports in one report: as many as a robot can carry services."""

MAX_CRL_BYTES = 1 << 20
"""Longest revocation list that is relayed: 15,000 to 20,000 certificates."""

MAX_STUN_SERVERS = 16
"""STUN servers in one welcome."""

MAX_LISTED_SIDECARS = 8192
"""Sidecars in one status."""

MAX_DURATION_S = 86_400.0
"""Longest deadline, lease or interval: one day. Anything longer is a unit mistake."""

MAX_REPORTED_COUNT = 1 << 53
"""Largest count of datagrams or requests in one report: the largest that a float holds exactly."""

MAX_CAPACITY = 1_000_000
"""Largest capacity of a server; a larger one is written as 0, no limit."""

MAX_COST_PER_REQUEST = 1e9
"""Largest cost of a request over an interface or at a server; a larger one is a mistake."""

MAX_MAPPED_COPIES = 256
"""Copies of one request: as many as a robot can have interfaces."""

US_PER_S = 1_000_000

T = TypeVar("T")
K = TypeVar("K", bound=int)
P = TypeVar("P", bound="Message")


def duration(microseconds: int, field: str, *, zero: bool = False) -> float:
    """Check a duration and convert it to seconds; 0 is valid only if `zero` allows it."""
    if microseconds == 0 and not zero:
        raise DecodeError(f"{field} is 0")
    if microseconds > MAX_DURATION_S * US_PER_S:
        raise DecodeError(f"{field} of {microseconds} us is longer than {MAX_DURATION_S:.0f} s")
    return microseconds / US_PER_S


def microseconds(seconds: float) -> int:
    """Convert seconds to microseconds for the network, rounded."""
    return round(seconds * US_PER_S)


def probability(value: float, field: str) -> float:
    """Check a probability."""
    if not (math.isfinite(value) and 0.0 <= value <= 1.0):
        raise DecodeError(f"{field} {value} is not a probability")
    return value


def cost(value: float, field: str) -> float:
    """Check what a request costs."""
    if not (math.isfinite(value) and 0.0 <= value <= MAX_COST_PER_REQUEST):
        raise DecodeError(f"{field} {value} is not within 0..{MAX_COST_PER_REQUEST:.0f}")
    return value


def at_most(value: int, limit: int, field: str) -> int:
    """Check an unsigned number."""
    if not 0 <= value <= limit:
        raise DecodeError(f"{field} {value} is not within 0..{limit}")
    return value


def version(value: int, field: str) -> Version:
    """Check a version."""
    return Version(at_most(value, MAX_VERSION, field))


def known(value: K, names: Mapping[K, T], field: str) -> T:
    """Check an enum value and convert it to the model's."""
    if value not in names:
        raise DecodeError(f"{field} has no meaning for the value {value}")
    return names[value]


def check_length(messages: Sequence[P], limit: int, field: str) -> None:
    """Check how many elements a repeated field has."""
    if len(messages) > limit:
        raise DecodeError(f"{field} has {len(messages)} elements, more than {limit}")


def each(messages: Sequence[P], limit: int, field: str, convert: Callable[[P], T]) -> tuple[T, ...]:
    """Convert a repeated field of at most `limit` elements."""
    check_length(messages, limit, field)
    return tuple(convert(message) for message in messages)


def unique(keys: Iterable[Hashable], field: str) -> None:
    """Check that no key occurs twice."""
    seen: set[Hashable] = set()
    for key in keys:
        if key in seen:
            raise DecodeError(f"{field} names {key!a} twice")
        seen.add(key)
