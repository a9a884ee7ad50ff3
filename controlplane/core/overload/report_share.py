"""Limits how fast the reports of each member are read: unread data waits at its sender.

One member alone gets `ENTRIES_PER_S`. That is part of a core, so many members that all send as much as they may would
take the whole of it. While the loop is busy, and reports are a good part of what it does, there is a level as well:
nobody's reports are read faster than that. It is the level to which those who send most have to be held for the rest to
fit (max-min fairness), so a member that sends less, as every member with ordinary reports does, notices nothing. The
level goes down as long as the loop is busy, and up again when it is not.

Times are monotonic seconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from plr.controlplane.core.base.member_table import MemberTable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from plr.protos.model.ids import NodeName

ENTRIES_PER_S = 2000.0
"""Entries of reports, each some 40 us to take at most: a robot with 8 interfaces that calls 4 services on 16 servers
reports 1300 a second."""

ENTRIES_BURST = 20_000.0
"""One report of maximum size, and half of another."""

LEAST_BURST = 2000.0
"""The same while there is a level: three reports of that robot."""

BUSY, IDLE = 0.8, 0.6
"""Shares of one core, taken by the loop, above which the level goes down, and below which it goes up."""

LEAST_ENTRIES_PER_S = 7500.0
"""All members together always have room for this many: a third of a core. Other causes of a busy loop, such as a fleet
that comes back, slow no reports below that."""

RISE = 1.1
"""Factor by which the level rises with each look at the load, once a second."""

BUSY_WEIGHT = 0.3
"""Weight of the newest sample in the average of the load."""

MEMORY_S = 3.0
"""Entries count for about this long: a flood is noticed within a second or two."""


@dataclass(slots=True)
class _Member:
    debt: float
    """Entries taken and not yet paid for by time."""
    recent: float
    """Entries taken recently, older ones with less and less weight."""
    at: float

    @classmethod
    def begin(cls, now: float) -> _Member:
        return cls(0.0, 0.0, now)


class ReportShares:
    """Counts the entries of each member, however many streams it opens."""

    def __init__(self) -> None:
        self.members = MemberTable(_Member.begin)
        self._level = math.inf
        self._busy = 0.0
        self.slowed = 0
        """Times that a member was not read for a while."""

    @property
    def entries_per_s(self) -> float:
        """How fast any one member's reports are read now."""
        return min(ENTRIES_PER_S, self._level)

    def take(self, name: NodeName, entries: int, now: float) -> bool:
        """Note that a report of this many entries was read; return whether to stop reading this member for a while."""
        member = self.members.of(name, now)
        self._pass(member, now)
        member.debt += entries
        member.recent += entries
        waits = self._wait_s(member) > 0.0
        self.slowed += waits
        return waits

    def wait_s(self, name: NodeName, now: float) -> float:
        """Return for how long nothing more is to be read of this member, at the present level."""
        member = self.members.get(name)
        if member is None:
            return 0.0
        self._pass(member, now)
        return self._wait_s(member)

    def _wait_s(self, member: _Member) -> float:
        burst = ENTRIES_BURST if math.isinf(self._level) else LEAST_BURST
        return max(0.0, member.debt - burst) / self.entries_per_s

    def _pass(self, member: _Member, now: float) -> None:
        passed_s = max(0.0, now - member.at)
        member.at = max(member.at, now)
        member.debt = max(0.0, member.debt - passed_s * self.entries_per_s)
        member.recent *= math.exp(-passed_s / MEMORY_S)

    def follow(self, busy: float, now: float) -> None:
        """Note that the loop took this share of one core since the last call, about a second ago."""
        self._busy += BUSY_WEIGHT * (busy - self._busy)
        if self._busy < IDLE:
            self._level = self._level * RISE if self._level < ENTRIES_PER_S else math.inf
        elif self._busy > BUSY:
            rates = []
            for member in self.members.values():
                self._pass(member, now)
                rates.append(member.recent / MEMORY_S)
            room = max(sum(rates) * BUSY / self._busy, LEAST_ENTRIES_PER_S)
            self._level = min(self._level, level(rates, room))


def level(rates: Sequence[float], room: float) -> float:
    """Return where the highest of these have to be cut for their sum to fit `room`; infinite if it fits."""
    if sum(rates) <= room:
        return math.inf
    left, count = room, len(rates)
    for rate in sorted(rates):
        if rate * count >= left:
            break
        left -= rate
        count -= 1
    return left / count
