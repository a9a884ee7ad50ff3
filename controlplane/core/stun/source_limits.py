"""Limits how often one source is answered over UDP, where the source may be forged.

An answer goes to whatever address the datagram claims to come from. So each address is sent no more than a sidecar's
own questions would be. Sources are told apart by what one subscriber cannot choose: an IPv4 address, an IPv6 /64.
"""

from __future__ import annotations

from collections import OrderedDict
from ipaddress import IPv6Address
from typing import TYPE_CHECKING

from plr.protos.base.token_bucket import TokenBucket

if TYPE_CHECKING:
    from plr.protos.model.ids import Address

ANSWERS_PER_S = 50.0
"""Rate to one source: a hundred robots behind one carrier's NAT, each asking every few seconds."""

ANSWERS_BURST = 200.0
"""Burst to one source: the same robots with two interfaces each, when they come back from an outage."""

MAX_SOURCES = 16_384
"""Sources remembered. One that has not asked for ANSWERS_BURST / ANSWERS_PER_S is as good as new, and goes first."""

UNLISTED_ANSWERS_PER_S = 1000.0
"""Rate to all unlisted sources together: more than a fleet asks, far less than a line carries."""

_PREFIX_BYTES = 8


class SourceLimits:
    """A token bucket for each source, in a table of limited size. Times are monotonic seconds."""

    def __init__(self, now: float) -> None:
        self._buckets: OrderedDict[str | bytes, TokenBucket] = OrderedDict()
        """Ordered by when they last asked, oldest first."""
        self._unlisted = TokenBucket(rate=UNLISTED_ANSWERS_PER_S, burst=UNLISTED_ANSWERS_PER_S, now=now)

    def __len__(self) -> int:
        return len(self._buckets)

    def allows(self, source: Address, now: float) -> bool:
        """Return whether this source may be answered again."""
        key = _key(source[0])
        bucket = self._buckets.get(key)
        if bucket is None:
            if not self._has_room(now):
                return self._unlisted.take(now)
            bucket = self._buckets[key] = TokenBucket(rate=ANSWERS_PER_S, burst=ANSWERS_BURST, now=now)
        else:
            self._buckets.move_to_end(key)
        return bucket.take(now)

    def _has_room(self, now: float) -> bool:
        """Make room by forgetting the source that asked least recently, unless its bucket still holds it back."""
        if len(self._buckets) < MAX_SOURCES:
            return True
        oldest, bucket = next(iter(self._buckets.items()))
        if not bucket.is_full(now):
            return False
        del self._buckets[oldest]
        return True


def _key(ip: str) -> str | bytes:
    return IPv6Address(ip).packed[:_PREFIX_BYTES] if ":" in ip else ip
