"""Remembers the last events of the fleet. When they are too many, the member with most of them loses its oldest: no
member, however restless, pushes out what is known of others.

Those of refused sidecars have a room of their own: in insecure mode, anybody may cause them, under any names."""

from __future__ import annotations

from collections import OrderedDict, deque
from itertools import islice
from typing import TYPE_CHECKING

from plr.controlplane.core.base.holders import Holders
from plr.protos.base.token_bucket import TokenBucket
from plr.protos.model.fleet_events import EventKind

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.protos.model.fleet_events import FleetEvent

    Owner = str | None

MAX_EVENTS = 8192
"""Events remembered: two for each of the sidecars that can be registered."""

MAX_REFUSALS = 1024
"""Events among these that tell of a refusal; beyond that the name with most of them loses its oldest."""

EVENTS_BURST = 64.0
"""Events of one member taken at once: a bad hour."""

EVENTS_PER_S = 1.0 / 30.0
"""Rate after that; each event is written to the disk."""

PRESENCE_BURST, PRESENCE_PER_S = 8.0, 0.1
"""Further events of one member that say whether it is present: these must not be missing after a restart. They come
first, so that a stream that ends all the time leaves the share for other events."""


class EventMemory:
    """Events in the order they came."""

    def __init__(self) -> None:
        self._events: OrderedDict[int, FleetEvent] = OrderedDict()
        self._members = _Owned()
        self._refusals = _Owned()
        self._shares: dict[Owner, tuple[TokenBucket, TokenBucket]] = {}
        """Shares of those who have events, so that there are no more shares than events; the second is for presence."""
        self.evicted = 0

    def __len__(self) -> int:
        return len(self._events)

    def __iter__(self) -> Iterator[FleetEvent]:
        return iter(self._events.values())

    @property
    def last_number(self) -> int:
        """Number of the newest event; 0 without any."""
        return next(reversed(self._events), 0)

    def last(self, count: int) -> list[FleetEvent]:
        """Return the last events, the oldest first."""
        return [*islice(reversed(self._events.values()), count)][::-1]

    def admits(self, owner: Owner, now: float, *, presence: bool = False) -> bool:
        """Return whether one more event of this member is within its share; the control plane's own always are.

        `presence`: it says whether the member is present. `now` is in monotonic seconds. The caller adds what is
        admitted.
        """
        if owner is None:
            return True
        share = self._shares.get(owner)
        if share is None:
            share = self._shares[owner] = (
                TokenBucket(rate=EVENTS_PER_S, burst=EVENTS_BURST, now=now),
                TokenBucket(rate=PRESENCE_PER_S, burst=PRESENCE_BURST, now=now),
            )
        return (presence and share[1].take(now)) or share[0].take(now)

    def add(self, event: FleetEvent) -> None:
        """Keep an event whose number is above all others'."""
        self._events[event.number] = event
        if event.kind is EventKind.REFUSED:
            self._refusals.add(event.node, event.number)
            if self._refusals.count > MAX_REFUSALS:
                self._evict(self._refusals)
        else:
            self._members.add(event.node, event.number)
        if len(self._events) > MAX_EVENTS:
            self._evict(self._members)

    def _evict(self, among: _Owned) -> None:
        owner, number = among.take_from_greediest()
        del self._events[number]
        if owner not in self._members:
            self._shares.pop(owner, None)
        self.evicted += 1


class _Owned:
    """The numbers of events, by whom they are about."""

    def __init__(self) -> None:
        self.count = 0
        self._of: dict[Owner, deque[int]] = {}
        self._holders: Holders[Owner] = Holders()

    def __contains__(self, owner: Owner) -> bool:
        return owner in self._of

    def add(self, owner: Owner, number: int) -> None:
        self._of.setdefault(owner, deque()).append(number)
        self._holders.add(owner)
        self.count += 1

    def take_from_greediest(self) -> tuple[Owner, int]:
        """Remove the oldest event of the owner with most of them; return both."""
        owner = self._holders.greediest()
        self._holders.remove(owner)
        own = self._of[owner]
        number = own.popleft()
        if not own:
            del self._of[owner]
        self.count -= 1
        return owner, number
