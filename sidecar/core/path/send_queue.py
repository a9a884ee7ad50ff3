"""Decides which of the symbols that wait for one path leave next.

Urgent before bulk: a message's priority comes first. Fresh before late: within a priority, messages that can still make
their deadline go first, earliest deadline first, and all others after them. So a backlog makes some messages miss
instead of making each message delay the next one. Among late messages, begun ones go first, then the oldest that can
still be of use: newer ones would overtake them until they expire. A message that arrives past its deadline follows
after those: after an outage the pace is low at first, and a request made then may seem hopeless but must not wait for
the backlog. A message that cannot even be answered before it expires goes last, as the pace may rise; when it does, the
message may be fresh again. No priority starves: while a lower one waits, it gets one symbol in SHARE.

The copies of one request on several paths are in one race (`MessageSymbols.siblings`). The path that sends a symbol
says when it expects the answer. Until that is overdue, the other paths send other messages first, if any wait. So where
one carrier cannot bear the load, carriers share it instead of all sending the same symbols; elsewhere all copies leave
at once. Copies of small requests always do.

One message may also be carried by several paths together (`message/sharing.py`). When nothing else waits that can be in
time, this path repeats what the others carry of such messages: first of those that can be in time, and after all that
waits of the others.
"""

from __future__ import annotations

import heapq
from itertools import count
from typing import TYPE_CHECKING, TypeAlias

from plr.sidecar.core.base.values import SHARE, Priority
from plr.sidecar.core.path.spare_time import SpareTime
from plr.sidecar.core.path.turn import LOOK_AGAIN_S, MAX_RUN, SharedTurn, SymbolRun, most_symbols, turn_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    from plr.sidecar.core.message.symbols import MessageSymbols
    from plr.sidecar.core.path.turn import Turn

PURGE_AT = 8
"""Entries that trigger the first search for messages that are over; the next one comes at twice their number."""
LOOK_AT_LEAST_EVERY_S = 1.0
"""So often an idle path looks whether what it might repeat is over (s), so as not to hold it in memory."""
BEGUN = float("-inf")
"""Sort key of begun messages, before the other late ones."""
_Entry: TypeAlias = "tuple[float, int, Turn]"
"""Sort key, order of arrival, and message."""


class _Class:
    """Messages of one priority by their prospects. Each heap goes after those named before it."""

    __slots__ = ("covered", "fresh", "heaps", "hopeless", "newest", "passed_over", "stale", "useless")

    def __init__(self) -> None:
        self.fresh: list[_Entry] = []
        """Can make their deadline; sorted by it, as the next two."""
        self.hopeless: list[_Entry] = []
        """Cannot make their deadline, which was still to come when that showed."""
        self.newest: list[_Entry] = []
        """Those of them whose deadline is still to come, latest first; entries that left may remain."""
        self.stale: list[_Entry] = []
        """Came past their deadline."""
        self.useless: list[_Entry] = []
        """Expire sooner than they can be answered, unless the pace rises; by expiry, latest first."""
        self.covered: list[_Entry] = []
        """Left to another path; sorted by when to look at them again."""
        self.heaps = (self.fresh, self.hopeless, self.stale, self.useless, self.covered)
        self.passed_over = 0
        """Symbols of higher priorities that left while something waited here."""

    def look_for_newest(self, now: float) -> None:
        """Rebuild `newest` from `hopeless`."""
        ahead = ((-entry.message.deadline, order, entry) for _, order, entry in self.hopeless)
        self.newest[:] = [item for item in ahead if -item[0] > now]
        heapq.heapify(self.newest)


class SendQueue:
    """Symbols that wait for one path. The outbox limits the number of messages."""

    __slots__ = ("_classes", "_entries", "_order", "_pulls", "_purge_at", "_spare_time", "expired", "rests_until")

    def __init__(self) -> None:
        self._classes = tuple(_Class() for _ in Priority)
        self._entries: dict[int, Turn] = {}
        self._spare_time = SpareTime(self._entries)
        self.rests_until = 0.0
        """Nothing leaves before this time unless something is added: the rest is left to other paths."""
        self._pulls = True
        self._order = count()
        self._purge_at = PURGE_AT
        self.expired = 0
        """Messages dropped because they expired."""

    def __len__(self) -> int:
        return len(self._entries)

    def add(self, message: MessageSymbols) -> None:
        """Queue all symbols of a message."""
        if message.number not in self._entries:
            self._insert(turn_of(message, repeats=True))

    def resend(self, message: MessageSymbols, indices: Iterable[int]) -> None:
        """Queue these symbols of a message again, before its others.

        Without any, look again at what is untaken of a message that several paths carry together.
        """
        entry = self._entries.get(message.number)
        if entry is None:
            entry = turn_of(message, repeats=False)
            entry.next = len(message)
            self._insert(entry)
        elif self._spare_time.remove(message.number):
            self._insert(entry)
        entry.again.extend(indices)

    def _insert(self, entry: Turn) -> None:
        message = entry.message
        if len(self._entries) >= self._purge_at:
            self._purge()
        self._entries[message.number] = entry
        self.rests_until = 0.0
        mine = self._classes[message.priority]
        if not any(mine.heaps):
            mine.passed_over = 0
        heapq.heappush(mine.fresh, (message.deadline, next(self._order), entry))

    def _purge(self) -> None:
        """Drop messages that are over but have not come up yet, so that they hold no memory.

        The engine's thread ends messages meanwhile: each is judged once, so that no list keeps what another one drops.
        """
        over = {number for number, entry in self._entries.items() if entry.message.over}
        for each in self._classes:
            for heap in (*each.heaps, each.newest):
                heap[:] = [item for item in heap if item[2].message.number not in over]
                heapq.heapify(heap)
        for number in over:
            del self._entries[number]
        self._spare_time.purge(over)
        self._purge_at = max(PURGE_AT, 2 * len(self._entries))

    def take(
        self,
        now: float,
        budget: int,
        pace: float = 0.0,
        round_trip_s: float = 0.0,
        *,
        pulls: bool = True,
        repeats: bool = True,
    ) -> SymbolRun | None:
        """Remove and return what leaves next: at most about `budget` bytes, but at least one symbol.

        Messages that are over or expired are dropped on the way. `pace` (bytes a second, 0 when unknown) and
        `round_trip_s` tell which can still make their deadline. `pulls`: the path is up, and may take what others could
        carry as well. `repeats`: it has capacity to spare, and may repeat what others carry.
        """
        if pulls is not self._pulls:
            self._pulls, self.rests_until = pulls, 0.0
        spare_time = self._spare_time
        for entry in spare_time.due(now) if spare_time.members else ():
            until = self._left_to_others(entry, now, pace, round_trip_s)
            if until is None:
                self._insert(entry)
            else:
                spare_time.add(entry, until)
        waiting = [
            each for each in self._classes if any(each.heaps) and self._head(each, now, pace, round_trip_s) is not None
        ]
        if spare_time.members:
            spare_time.drop_over(now)
        may_repeat = repeats and bool(spare_time.members)
        if may_repeat and not any(each.fresh for each in waiting):
            run = spare_time.take(now, budget, round_trip_s, late=False)
            if run is not None:
                return run
        while waiting:
            chosen, most = waiting[0], MAX_RUN
            for lower in reversed(waiting[1:]):
                if lower.passed_over >= SHARE:
                    chosen, most = lower, lower.passed_over // SHARE
                    break
            run = self._take(chosen, now, budget, most, pace, round_trip_s)
            if run is None:
                waiting.remove(chosen)
                continue
            self._note_turn(waiting, chosen, run.symbols)
            return run
        run = spare_time.take(now, budget, round_trip_s) if may_repeat else None
        if run is None and self._entries:
            self.rests_until = min(spare_time.next_look, now + LOOK_AT_LEAST_EVERY_S)
        return run

    def _note_turn(self, waiting: list[_Class], chosen: _Class, symbols: int) -> None:
        higher = True
        for each in waiting:
            if each is chosen:
                each.passed_over = max(0, each.passed_over - SHARE * symbols) if each is not waiting[0] else 0
                higher = False
                continue
            for heap in each.heaps:
                if heap:
                    heap[0][2].waits()  # the other paths must not rely on this one for it
            if not higher:
                each.passed_over = min(each.passed_over + symbols, SHARE * MAX_RUN)

    def _take(
        self, chosen: _Class, now: float, budget: int, most: int, pace: float, round_trip_s: float
    ) -> SymbolRun | None:
        while (heap := self._head(chosen, now, pace, round_trip_s)) is not None:
            entry = heap[0][2]
            message = entry.message
            run = entry.take(min(most, most_symbols(message, budget)))
            if run is not None:
                entry.goes_on(now, pace, round_trip_s)
                if entry.has_left:
                    self._drop(heap)
                elif heap is not chosen.fresh and heap is not chosen.covered:
                    heapq.heapreplace(heap, (BEGUN, heap[0][1], entry))
                return SymbolRun(message, *run)
            self._drop(heap)
        return None

    def _head(self, each: _Class, now: float, pace: float, round_trip_s: float) -> list[_Entry] | None:
        """Return the heap whose head goes next; drop heads that are over, and move those that belong elsewhere."""
        if each.newest:
            self._hope_again(each, now, pace, round_trip_s)
        covered = each.covered
        while covered and covered[0][2].covered_until(now, pace, round_trip_s) is None:
            _, order, entry = heapq.heappop(covered)
            heapq.heappush(each.fresh, (entry.message.deadline, order, entry))
        for heap in each.heaps:
            while heap:
                _, order, entry = heap[0]
                message = entry.message
                if message.over:
                    self._drop(heap)
                elif message.expires <= now:
                    self.expired += 1
                    self._drop(heap)
                elif heap is each.hopeless or heap is each.stale:
                    if entry.can_end_by(message.expires, now, pace, round_trip_s):
                        return heap
                    self._move(heap, each.useless, -message.expires)
                elif heap is not each.fresh:
                    return heap
                elif (
                    until := entry.covered_until(now, pace, round_trip_s)
                    if self._pulls
                    else self._left_to_others(entry, now, pace, round_trip_s)
                ) is not None:
                    entry.waits()
                    heapq.heappop(heap)
                    if isinstance(entry, SharedTurn):
                        self._spare_time.add(entry, until)
                    else:
                        heapq.heappush(covered, (until, order, entry))
                elif not entry.can_end_by(message.deadline, now, pace, round_trip_s):
                    self._move(heap, each.hopeless if message.deadline > now else each.stale, message.deadline)
                    if message.deadline > now:
                        heapq.heappush(each.newest, (-message.deadline, order, entry))
                        if len(each.newest) > 2 * len(each.hopeless) + PURGE_AT:
                            each.look_for_newest(now)
                else:
                    return heap
        return None

    def _left_to_others(self, entry: Turn, now: float, pace: float, round_trip_s: float) -> float | None:
        """Return until when to leave it to other paths; None: not at all."""
        if not self._pulls and isinstance(entry, SharedTurn) and not entry.again:
            return now + LOOK_AGAIN_S
        return entry.covered_until(now, pace, round_trip_s)

    def _hope_again(self, each: _Class, now: float, pace: float, round_trip_s: float) -> None:
        """Bring back messages that can make their deadline after all, as the pace rose: if any can, the newest does."""
        newest = each.newest
        while newest:
            message = newest[0][2].message
            if message.deadline <= now:
                newest.clear()
            elif self._entries.get(message.number) is not newest[0][2]:
                heapq.heappop(newest)
            else:
                break
        if not newest or not newest[0][2].can_end_by(newest[0][2].message.deadline, now, pace, round_trip_s):
            return
        still: list[_Entry] = []
        for item in each.hopeless:
            _, order, entry = item
            if entry.can_end_by(entry.message.deadline, now, pace, round_trip_s):
                heapq.heappush(each.fresh, (entry.message.deadline, order, entry))
            else:
                still.append(item)
        each.hopeless[:] = still
        heapq.heapify(each.hopeless)
        each.look_for_newest(now)

    @staticmethod
    def _move(heap: list[_Entry], to: list[_Entry], by: float) -> None:
        """Move the head; begun messages stay in front."""
        _, order, entry = heapq.heappop(heap)
        heapq.heappush(to, (BEGUN if entry.begun else by, order, entry))

    def _drop(self, heap: list[_Entry]) -> None:
        """Take out the head, of which nothing waits any more; keep a shared one for spare time, if it is not over."""
        entry = heapq.heappop(heap)[2]
        if isinstance(entry, SharedTurn) and not entry.message.over:
            self._spare_time.add(entry)
        else:
            del self._entries[entry.message.number]

    def clear(self) -> list[tuple[MessageSymbols, tuple[int, ...]]]:
        """Empty the queue and return each message with its symbols that did not leave and no other path would carry.

        Of a message that several paths carry together there may be none.
        """
        left = [(entry.message, entry.leave()) for entry in self._entries.values()]
        for each in self._classes:
            for heap in each.heaps:
                heap.clear()
            each.newest.clear()
        self._entries.clear()
        self._spare_time.clear()
        self._purge_at = PURGE_AT
        return [(message, indices) for message, indices in left if indices or _is_shared(message)]


def _is_shared(message: MessageSymbols) -> bool:
    return message.sharing is not None and not message.over
