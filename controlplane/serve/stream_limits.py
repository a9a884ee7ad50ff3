"""Limits what one sidecar may demand of the control plane over its streams."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from plr.controlplane.core.base.member_table import MemberTable
from plr.protos.base.token_bucket import TokenBucket
from plr.protos.model.members import CandidateSet, ServiceSet

if TYPE_CHECKING:
    from plr.protos.model.stream import SidecarMessage

TOO_MANY_STREAMS = "too_many_streams"
TOO_FAST = "too_fast"

MAX_STREAM_MESSAGE_BYTES = 4 << 20
"""Longest message either way: 4096 peers with their credentials stay below, as does a report on as many paths."""

MAX_FIRST_BYTES = 64 << 10
"""Longest first message of a stream, from an unknown sender: a registration takes 4 KiB at most."""

MAX_STREAMS_PER_NAME = 3
"""Open streams of one name: the one in use, the one that replaces it, and one that has just been replaced."""

MAX_STREAMS_PER_CONNECTION = 8
"""Open streams of one connection: a sidecar opens one, a health check or reflection a few."""

MESSAGES_PER_S = 50.0
"""Message rate of a member: besides reports it sends heartbeats, acks and sometimes its addresses, 20 a second at most.
"""

MESSAGES_BURST = 500.0
"""Burst of messages: one message of the largest size takes half of it."""

BYTES_PER_TOKEN = 16 << 10
"""A message costs one token, and one more for each of these many bytes."""


ENTRIES_PER_TOKEN = 64
"""An announcement costs one more token for each of these many addresses, labels or services: each takes some 10 us."""


class MemberRates:
    """Limits the rate of each member: its messages, weighted by size, plus its reports at their interval.

    All streams of a member share its rate, so that another stream does not renew it.
    """

    def __init__(self, *, report_interval_s: float) -> None:
        # Twice the rate asked for: a clock may be fast, and after a stall reports arrive together.
        rate = MESSAGES_PER_S + 2.0 / report_interval_s
        self._members = MemberTable(lambda now: TokenBucket(rate=rate, burst=MESSAGES_BURST, now=now))

    def take(self, member: str, size: int, now: float) -> bool:
        """Take tokens for a message of `size` bytes; return False if it comes too fast."""
        return self._members.of(member, now).take(now, 1.0 + size // BYTES_PER_TOKEN)

    def take_entries(self, member: str, entries: int, now: float) -> bool:
        """Take tokens for what an announcement of that message consists of; return False if it comes too fast."""
        cost = entries / ENTRIES_PER_TOKEN
        return cost < 1.0 or self._members.of(member, now).take(now, cost)


def announced_entries(message: SidecarMessage) -> int:
    """Return the number of addresses, labels or services that a message announces; 0 if it announces none."""
    match message:
        case CandidateSet():
            return len(message.candidates) + len(message.labels) + len(message.down)
        case ServiceSet():
            names = message.unmet, message.unreached, message.untyped
            return len(message.offers) + len(message.uses) + sum(map(len, names))
    return 0


class StreamCount:
    """Counts open streams by name."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()

    def enter(self, name: str) -> bool:
        """Count one more stream; return False, and do not count it, if that is too many."""
        if self._counts[name] >= MAX_STREAMS_PER_NAME:
            return False
        self._counts[name] += 1
        return True

    def leave(self, name: str) -> None:
        """Count one stream fewer."""
        self._counts[name] -= 1
        if self._counts[name] <= 0:
            del self._counts[name]
