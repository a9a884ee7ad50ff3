"""Limits members that change what they announce all the time: every change is sent to all others.

So each member has its share. A change within it counts at once. One beyond it waits, and only the last of its kind
does. Each change repeats all that others know of the member: if that is much, it has a share of bytes, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from plr.controlplane.core.base.member_table import MemberTable
from plr.protos.base.token_bucket import TokenBucket

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from plr.controlplane.core.registry.registry import StreamId
    from plr.protos.model.ids import NodeName
    from plr.protos.model.members import CandidateSet, ServiceSet

    Announcement = CandidateSet | ServiceSet

CHANGES_BURST = 30.0
"""Covers a start and some minutes of interfaces that come and go."""

CHANGES_PER_S = 0.2
"""Rate after that: with each change everybody receives all peers, some 20 kB in a fleet of 20 servers."""

LIGHT_BYTES = 5000
"""Announcements up to this size need no share of bytes: the share of changes limits them to 1 kB a second."""

BYTES_BURST = 1_000_000.0
"""Bytes sent about one member at once, to each listener: those of a server whose 150 services come up one by one, the
last ones with 10 kB each."""

BYTES_PER_S = 1000.0
"""Rate after that: what a robot's control stream takes anyway, on a link that is billed."""


@dataclass(slots=True)
class _Share:
    changes: TokenBucket
    told_bytes: float
    """Sent, and not yet paid for by time."""
    at: float

    @classmethod
    def begin(cls, now: float) -> _Share:
        return cls(TokenBucket(rate=CHANGES_PER_S, burst=CHANGES_BURST, now=now), 0.0, now)

    def is_spent(self, now: float) -> bool:
        """Return whether only light changes of this member are sent for a while."""
        self._pass(now)
        return self.told_bytes > BYTES_BURST

    def tell(self, size: int, now: float) -> None:
        self._pass(now)
        self.told_bytes += size

    def _pass(self, now: float) -> None:
        self.told_bytes = max(0.0, self.told_bytes - BYTES_PER_S * max(0.0, now - self.at))
        self.at = max(self.at, now)


class Restlessness:
    """Counts the changes of each member, and keeps those that wait. Times are monotonic seconds."""

    def __init__(self) -> None:
        self.shares = MemberTable(_Share.begin)
        self._waiting: dict[NodeName, tuple[StreamId, dict[type[Announcement], Announcement]]] = {}
        self._look_at: float | None = None
        self.held = 0
        """Changes that had to wait."""

    def next_time(self) -> float | None:
        """Return when to look for what is `due`; None while nothing waits."""
        return self._look_at

    def admits(self, name: NodeName, stream: StreamId, told: Announcement, size: int, now: float) -> bool:
        """Return whether this counts now; otherwise it waits, in place of what waited before.

        `size` is the number of bytes that each other member is told then.
        """
        waiting_stream, waiting = self._waiting.get(name, (stream, {}))
        if waiting_stream == stream and waiting:
            waiting[type(told)] = told
            self.held += 1
            return False
        if self.may_tell(name, size, now) and self.take(name, now):
            self.tell(name, size, now)
            return True
        self._waiting[name] = (stream, {type(told): told})
        self.held += 1
        if self._look_at is None:
            self._look_at = now + 1.0 / CHANGES_PER_S
        return False

    def take(self, name: NodeName, now: float) -> bool:
        """Count a change of this member; return False if that exceeds its share."""
        return self.shares.of(name, now).changes.take(now)

    def may_tell(self, name: NodeName, size: int, now: float) -> bool:
        """Return whether this many bytes are within this member's share."""
        return size <= LIGHT_BYTES or not self.shares.of(name, now).is_spent(now)

    def tell(self, name: NodeName, size: int, now: float) -> None:
        """Count this many bytes sent about this member, whether or not it may."""
        self.shares.of(name, now).tell(size, now)

    def forget(self, name: NodeName) -> None:
        """Note that a stream of this member begins or ends: it announces everything again. Its share stays as it is."""
        self._waiting.pop(name, None)

    def due(
        self, now: float, size_of: Callable[[NodeName, Collection[Announcement]], int]
    ) -> list[tuple[NodeName, StreamId, list[Announcement]]]:
        """Return what has waited long enough; `size_of` tells how many bytes each other member is told then."""
        if self._look_at is None or self._look_at > now:
            return []
        found = []
        for name, (stream, waiting) in list(self._waiting.items()):
            told = list(waiting.values())
            size = size_of(name, told)
            if self.may_tell(name, size, now):
                self.take(name, now)
                self.tell(name, size, now)
                found.append((name, stream, told))
                del self._waiting[name]
        self._look_at = now + 1.0 / CHANGES_PER_S if self._waiting else None
        return found
