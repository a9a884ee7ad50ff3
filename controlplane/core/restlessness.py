"""Members that change what they announce all the time: every change is told to all others, so each has its share.

A change within the share counts at once. One beyond it waits, and only the last of its kind does.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING

from protos.token_bucket import TokenBucket

if TYPE_CHECKING:
    from controlplane.core.registry import StreamId
    from protos.model import CandidateSet, NodeName, ServiceSet

    Announcement = CandidateSet | ServiceSet

CHANGES_BURST = 30.0
"""A start and some minutes of interfaces that come and go."""

CHANGES_PER_S = 0.2
"""After that: everybody is told of all peers with each, some 20 kB in a fleet of 20 servers."""

MAX_MEMBERS = 8192
"""Members whose changes are counted, the one that changed longest ago goes: twice those that can be registered."""


class Restlessness:
    """Counts the changes of each member, and keeps those that wait. Times are monotonic seconds."""

    def __init__(self) -> None:
        self._shares: OrderedDict[NodeName, TokenBucket] = OrderedDict()
        self._waiting: dict[NodeName, tuple[StreamId, dict[type[Announcement], Announcement]]] = {}
        self._look_at: float | None = None
        self.held = 0
        """Changes that had to wait."""

    def next_time(self) -> float | None:
        """When to look for what has `due`; None while nothing waits."""
        return self._look_at

    def admits(self, name: NodeName, stream: StreamId, told: Announcement, now: float) -> bool:
        """Whether this counts now; else it waits, in place of what waited before."""
        waiting_stream, waiting = self._waiting.get(name, (stream, {}))
        if waiting_stream == stream and waiting:
            waiting[type(told)] = told
            self.held += 1
            return False
        if self.take(name, now):
            return True
        self._waiting[name] = (stream, {type(told): told})
        self.held += 1
        if self._look_at is None:
            self._look_at = now + 1.0 / CHANGES_PER_S
        return False

    def take(self, name: NodeName, now: float) -> bool:
        """Count a change of this member; False if that is more than its share."""
        share = self._shares.get(name)
        if share is None:
            share = self._shares[name] = TokenBucket(rate=CHANGES_PER_S, burst=CHANGES_BURST, now=now)
            if len(self._shares) > MAX_MEMBERS:
                self._shares.popitem(last=False)
        self._shares.move_to_end(name)
        return share.take(now)

    def forget(self, name: NodeName) -> None:
        """A stream of this member begins or ends: it says anew what it has to say. Its share stays what it is."""
        self._waiting.pop(name, None)

    def due(self, now: float) -> list[tuple[NodeName, StreamId, list[Announcement]]]:
        """What has waited for long enough."""
        if self._look_at is None or self._look_at > now:
            return []
        found = [(name, stream, list(told.values())) for name, (stream, told) in self._waiting.items()]
        for name in self._waiting:
            self.take(name, now)
        self._waiting.clear()
        self._look_at = None
        return found
