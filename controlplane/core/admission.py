"""Who is let in next, and when: a narrow gate with a waiting line that overload cannot make useless. Sans-IO.

A line that is served oldest first works, once it is longer than its clients' patience, for clients that have just given
up: nobody gets in although the server is busy, and that lasts (a metastable failure). So here the newest of a source is
served first: who is served has waited least, and is still there. The sources are served in turn, so that one that sends
more than all others together keeps none of them out.

Only so many are on their way at once between their turn and their first call: what is begun is ended before more is
begun. Who is on the way for longer than any healthy network takes (a stranger who stops in the middle) does not count
any more.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Hashable

T = TypeVar("T", bound="Hashable")


class Admission(Generic[T]):
    """Decides for items that wait, each with its source; `now` is monotonic seconds. No call takes longer for many.

    Args:
        most_waiting: items in the line; of more, the source that has most of them loses its oldest.
        most_on_the_way: items that have had their turn and are not over.
        on_the_way_s: for how long one counts as such.
    """

    __slots__ = (
        "_by_length",
        "_longest",
        "_most_on_the_way",
        "_most_waiting",
        "_on_the_way",
        "_on_the_way_s",
        "_sources",
        "_waiting",
    )

    def __init__(self, *, most_waiting: int, most_on_the_way: int, on_the_way_s: float) -> None:
        self._most_waiting = most_waiting
        self._most_on_the_way = most_on_the_way
        self._on_the_way_s = on_the_way_s
        self._waiting: dict[T, str] = {}
        """All in the line, with their sources."""
        self._sources: OrderedDict[str, OrderedDict[T, None]] = OrderedDict()
        """The line of each source, oldest first; the source whose turn it is comes first."""
        self._by_length: dict[int, dict[str, None]] = {}
        """The sources by the length of their lines."""
        self._longest = 0
        self._on_the_way: OrderedDict[T, float] = OrderedDict()
        """Since when, oldest first."""

    def __len__(self) -> int:
        """Return how many wait."""
        return len(self._waiting)

    def wait(self, item: T, source: str) -> T | None:
        """One more waits; returns who has to go for it, if there is no room. It may be the same one."""
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
        """It does not wait any more; without effect if it does not."""
        source = self._waiting.pop(item, None)
        if source is None:
            return
        line = self._sources[source]
        del line[item]
        self._relist(source, len(line) + 1, len(line))
        if not line:
            del self._sources[source]

    def next(self, now: float) -> T | None:
        """Return whose turn it is, who is on the way from now on; None if nobody waits or too many are on the way."""
        self._forget_stuck(now)
        if not self._sources or len(self._on_the_way) >= self._most_on_the_way:
            return None
        source, line = next(iter(self._sources.items()))
        self._sources.move_to_end(source)
        item = next(reversed(line))
        self.leave(item)
        self._on_the_way[item] = now
        return item

    def over(self, item: T) -> bool:
        """It has come through, or never will; returns whether it was on the way."""
        return self._on_the_way.pop(item, None) is not None

    def next_at(self) -> float | None:
        """When to ask for the next one at the latest, although nobody was over; None if nobody waits."""
        if not self._waiting:
            return None
        if len(self._on_the_way) < self._most_on_the_way:
            return 0.0
        return next(iter(self._on_the_way.values())) + self._on_the_way_s

    def _forget_stuck(self, now: float) -> None:
        while self._on_the_way:
            item, since = next(iter(self._on_the_way.items()))
            if now < since + self._on_the_way_s:
                return
            del self._on_the_way[item]

    def _relist(self, source: str, before: int, after: int) -> None:
        if before:
            of_length = self._by_length[before]
            del of_length[source]
            if not of_length:
                del self._by_length[before]
        if after:
            self._by_length.setdefault(after, {})[source] = None
        # By one up or down at a time: the longest line is found in one step.
        if after > self._longest or (before == self._longest and before not in self._by_length):
            self._longest = after
