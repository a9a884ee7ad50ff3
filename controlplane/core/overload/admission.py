"""Decides who is let in next, and when: a narrow gate with a waiting line that overload cannot make useless. Sans-IO.

A line served oldest first works, once it is longer than its clients' patience, for clients that have just given up:
nobody gets in although the server is busy, and that lasts (a metastable failure). So the newest item of a source is
served first: it has waited least, and is still there. The sources are served in turn, so that one that sends more than
all others together keeps none of them out.

Only a limited number are on their way at once between their turn and their registration: what is begun is ended before
more is begun. A stranger that stops in the middle counts for as long as a healthy network takes. A proven member counts
for longer, since most likely it is we who have not come to it yet, but each member only once.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Hashable

T = TypeVar("T", bound="Hashable")


class Admission(Generic[T]):
    """Decides for items that wait, each with its source; `now` is monotonic seconds. No call takes longer for many.

    Args:
        most_waiting: items in the line; beyond that, the source with most of them loses its oldest.
        most_on_the_way: items that have had their turn and are not over.
        stranger_s: for how long one counts as such.
        member_s: the same from the proof of being a member.
    """

    __slots__ = (
        "_by_length",
        "_longest",
        "_member_s",
        "_members",
        "_most_on_the_way",
        "_most_waiting",
        "_sources",
        "_stranger_s",
        "_strangers",
        "_waiting",
    )

    def __init__(self, *, most_waiting: int, most_on_the_way: int, stranger_s: float, member_s: float) -> None:
        self._most_waiting = most_waiting
        self._most_on_the_way = most_on_the_way
        self._stranger_s = stranger_s
        self._member_s = member_s
        self._waiting: dict[T, str] = {}
        """All items in the line, with their sources."""
        self._sources: OrderedDict[str, OrderedDict[T, None]] = OrderedDict()
        """The line of each source, oldest first; the source whose turn it is comes first."""
        self._by_length: dict[int, dict[str, None]] = {}
        """The sources by the length of their lines."""
        self._longest = 0
        self._strangers: OrderedDict[T, float] = OrderedDict()
        """Items on the way and not proven yet; since when, oldest first."""
        self._members: OrderedDict[str, tuple[T, float]] = OrderedDict()
        """Items on the way, by their proven names; since when, oldest first."""

    def __len__(self) -> int:
        """Return how many wait."""
        return len(self._waiting)

    def wait(self, item: T, source: str) -> T | None:
        """Add one to the line; return which one has to leave for it, if there is no room. It may be the same one."""
        self._waiting[item] = source
        line = self._sources.setdefault(source, OrderedDict())
        line[item] = None
        self._relist(source, len(line) - 1, len(line))
        if len(self._waiting) <= self._most_waiting:
            return None
        victim = next(iter(self._sources[next(iter(self._by_length[self._longest]))]))
        self.leave(victim)
        return victim

    def leave(self, item: T) -> None:
        """Remove it from the line; without effect if it does not wait."""
        source = self._waiting.pop(item, None)
        if source is None:
            return
        line = self._sources[source]
        del line[item]
        self._relist(source, len(line) + 1, len(line))
        if not line:
            del self._sources[source]

    def next(self, now: float) -> T | None:
        """Return whose turn it is, now on the way; None if nobody waits or too many are on the way."""
        self._forget_stuck(now)
        if not self._sources or self.on_the_way >= self._most_on_the_way:
            return None
        source, line = next(iter(self._sources.items()))
        self._sources.move_to_end(source)
        item = next(reversed(line))
        self.leave(item)
        self._strangers[item] = now
        return item

    @property
    def on_the_way(self) -> int:
        """How many have had their turn and are not over, as far as they count."""
        return len(self._strangers) + len(self._members)

    def proven(self, item: T, name: str, now: float) -> None:
        """Note that it is this member, still on its way; an earlier one under the same name no longer counts."""
        self._strangers.pop(item, None)
        self._members.pop(name, None)
        self._members[name] = item, now

    def over(self, item: T, name: str | None = None) -> bool:
        """Note that it has come through, or never will; `name` if it is proven. Return whether there is more room."""
        if name is not None and name in self._members and self._members[name][0] == item:
            del self._members[name]
            return True
        return self._strangers.pop(item, None) is not None

    def next_at(self) -> float | None:
        """Return when to ask for the next one at the latest, even if nobody was over; None if nobody waits."""
        if not self._waiting:
            return None
        if self.on_the_way < self._most_on_the_way:
            return 0.0
        strangers = (since + self._stranger_s for since in self._strangers.values())
        members = (since + self._member_s for _, since in self._members.values())
        return min(next(strangers, math.inf), next(members, math.inf))

    def _forget_stuck(self, now: float) -> None:
        while self._strangers and now >= next(iter(self._strangers.values())) + self._stranger_s:
            self._strangers.popitem(last=False)
        while self._members and now >= next(iter(self._members.values()))[1] + self._member_s:
            self._members.popitem(last=False)

    def _relist(self, source: str, before: int, after: int) -> None:
        if before:
            of_length = self._by_length[before]
            del of_length[source]
            if not of_length:
                del self._by_length[before]
        if after:
            self._by_length.setdefault(after, {})[source] = None
        # Lengths change by one at a time, so the longest line is found in one step.
        if after > self._longest or (before == self._longest and before not in self._by_length):
            self._longest = after
