"""Keeps the shared messages of which nothing waits for this path alone: what it may repeat in spare time.

Some symbols of such a message may still be untaken: other paths would deliver them sooner. Whether that is still so is
looked at again and again.
"""

from __future__ import annotations

import heapq
from itertools import count
from typing import TYPE_CHECKING

from plr.sidecar.core.base.timers import NEVER
from plr.sidecar.core.path.turn import LOOK_AGAIN_S, SharedTurn, SymbolRun, most_symbols

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from plr.sidecar.core.path.turn import Turn


class SpareTime:
    """Shared messages that go after all others."""

    __slots__ = ("_declined", "_entries", "_order", "_repeatable", "members")

    def __init__(self, entries: dict[int, Turn]) -> None:
        """Create it empty. `entries`: all messages on the path; what comes to its end here is taken out of them."""
        self._entries = entries
        self.members: dict[int, SharedTurn] = {}
        """By number; do not change it."""
        self._declined: list[tuple[float, int, SharedTurn]] = []
        """Left to other paths: when to look again, order, message. Entries that were removed may remain, as below."""
        self._repeatable: list[tuple[bool, float, int, SharedTurn]] = []
        """Too late, deadline, order, message."""
        self._order = count()

    def add(self, entry: SharedTurn, look_at: float | None = None) -> None:
        """Add a message; `look_at`: some of it is left to other paths, and is looked at again at this time (s)."""
        self.members[entry.message.number] = entry
        self._list(entry)
        if look_at is not None:
            self._look_again(entry, look_at)

    def _look_again(self, entry: SharedTurn, at: float) -> None:
        if not entry.declined:
            entry.declined = True
            heapq.heappush(self._declined, (at, next(self._order), entry))

    def _list(self, entry: SharedTurn) -> None:
        if not entry.listed:
            entry.listed = True
            heapq.heappush(self._repeatable, (False, entry.message.deadline, next(self._order), entry))

    def _unlist(self) -> None:
        heapq.heappop(self._repeatable)[-1].listed = False

    def remove(self, number: int) -> bool:
        """Remove a message if it is here; return whether it was."""
        was_here = self.members.pop(number, None) is not None
        if not self.members:  # an idle path holds no message in memory
            self._forget_lists()
        return was_here

    def _forget_lists(self) -> None:
        for *_, entry in self._declined:
            entry.declined = False
        for *_, entry in self._repeatable:
            entry.listed = False
        self._declined.clear()
        self._repeatable.clear()

    def due(self, now: float) -> Iterator[SharedTurn]:
        """Remove and yield what is to be looked at again by now."""
        declined = self._declined
        while declined and declined[0][0] <= now:
            entry = heapq.heappop(declined)[2]
            entry.declined = False
            if not self._is_member(entry):
                continue
            if entry.message.over:
                self._end(entry)
            elif entry.has_left:
                self._list(entry)
            else:
                self.remove(entry.message.number)
                yield entry

    @property
    def next_look(self) -> float:
        """When to look again at what is left to other paths (s); NEVER if nothing is."""
        return self._declined[0][0] if self._declined else NEVER

    def drop_over(self, now: float) -> None:
        """End the messages at the head that need nothing more, even while something else goes first."""
        repeatable = self._repeatable
        while repeatable:
            entry = repeatable[0][-1]
            if not self._is_member(entry):
                self._unlist()
            elif entry.message.over or entry.message.expires <= now:
                self._unlist()
                self._end(entry)
            else:
                break

    def take(self, now: float, budget: int, round_trip_s: float, *, late: bool = True) -> SymbolRun | None:
        """Return symbols that other paths carry, of the message that is most urgent and can still be in time.

        `late`: if there is none, return those of a message that is too late.
        """
        repeatable = self._repeatable
        while True:
            self.drop_over(now)
            if not repeatable:
                return None
            is_late, deadline, order, entry = repeatable[0]
            message = entry.message
            if not is_late and deadline <= now + round_trip_s:
                heapq.heapreplace(repeatable, (True, deadline, order, entry))
            elif is_late and not late:
                return None
            elif (run := entry.repeat(most_symbols(message, budget))) is not None:
                return SymbolRun(message, *run, repeats=True)
            else:
                self._unlist()
                if entry.has_left:
                    self._end(entry)
                else:  # something got lost meanwhile, and may be taken again
                    self._look_again(entry, now + LOOK_AGAIN_S)

    def _is_member(self, entry: SharedTurn) -> bool:
        return self.members.get(entry.message.number) is entry

    def _end(self, entry: SharedTurn) -> None:
        """Take out a message of which this path sends nothing more."""
        entry.leave()
        self.remove(entry.message.number)
        self._entries.pop(entry.message.number, None)

    def purge(self, over: Collection[int]) -> None:
        """Forget messages with these numbers, which are over, and what was removed."""
        self.members = {number: entry for number, entry in self.members.items() if number not in over}
        for item in self._repeatable:
            item[-1].listed = self._is_member(item[-1])
        for *_, entry in self._declined:
            entry.declined = self._is_member(entry)
        self._declined[:] = [item for item in self._declined if item[-1].declined]
        self._repeatable[:] = [item for item in self._repeatable if item[-1].listed]
        heapq.heapify(self._declined)
        heapq.heapify(self._repeatable)

    def clear(self) -> None:
        """Forget everything."""
        self.members.clear()
        self._forget_lists()
