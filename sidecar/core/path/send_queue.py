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

One message may also be carried by several paths together (`message/sharing.py`). When nothing else waits, this path
repeats what the others carry of such messages.
"""

from __future__ import annotations

import heapq
from collections import deque
from itertools import count
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from plr.sidecar.core.base.timers import NEVER
from plr.sidecar.core.base.values import SHARE, Priority
from plr.sidecar.core.message.sharing import OFFER_S
from plr.sidecar.core.wire.frame import FRAGMENT_OVERHEAD_BYTES

if TYPE_CHECKING:
    from collections.abc import Iterable

    from plr.sidecar.core.message.sharing import Sharing
    from plr.sidecar.core.message.symbols import MessageSymbols

HASTE = 1.25
"""A message that has not begun to leave is late when this many times its sending time no longer fits: a message that
begins should also finish."""
PATIENCE = 0.5
"""An answer that another path expects is overdue after this share of the time between the expected answer and the
deadline: there should be time left for this path."""

SMALL = 0.1
"""A message that takes less than this share of the remaining time is sent at once anyway: others hardly wait for it."""


class Turn:
    """One message on one path."""

    __slots__ = ("_end", "again", "begun", "message", "next")

    def __init__(self, message: MessageSymbols) -> None:
        self.message = message
        self.next = 0
        self._end = len(message)
        self.again: deque[int] = deque()
        """Symbols to be sent once more."""
        self.begun = False
        """Whether some of its symbols have left."""

    def take(self, most: int) -> tuple[int, int] | None:
        """Remove and return the next consecutive symbols as (first, count), at most `most`; None if none is left."""
        needs = self.message.needs
        again = self.again
        while again:
            first = again.popleft()
            if needs(first):
                end = first + 1
                while again and again[0] == end and end - first < most and needs(end):
                    again.popleft()
                    end += 1
                return first, end - first
        last = self._end
        first = self.next
        while first < last and not needs(first):
            first += 1
        end = first
        limit = min(last, first + most)
        while end < limit and needs(end):
            end += 1
        self.next = end
        return (first, end - first) if end > first else None

    @property
    def has_left(self) -> bool:
        """Whether each of its symbols that were queued has left."""
        return not self.again and self.next >= len(self.message)

    def leave(self) -> tuple[int, ...]:
        """Leave the path; return the symbols that still have to travel and that no other path would carry."""
        self.waits()
        return tuple(filter(self.message.needs, (*self.again, *range(self.next, self._end))))

    def can_end_by(self, end: float, now: float, pace: float, round_trip_s: float) -> bool:
        """Return whether its last symbol can be answered before `end` at this pace (bytes a second; 0: unknown)."""
        if not pace:
            return now < end
        sending_s = self._sending_s(pace) * (1.0 if self.begun else HASTE)
        return now + sending_s + round_trip_s < end

    def goes_on(self, now: float, pace: float, round_trip_s: float) -> None:
        """Tell its siblings when to expect the answer: some of it has been taken to be sent."""
        self.begun = True
        self.message.expected_at = now + self._sending_s(pace) + round_trip_s if pace else NEVER

    def waits(self) -> None:
        """Withdraw the expected answer: something else goes first."""
        self.message.expected_at = NEVER

    def covered_until(self, now: float, pace: float, round_trip_s: float) -> float | None:
        """Return until when to leave it to a path that expects the answer in time and sooner; None: not at all."""
        message = self.message
        if len(message.siblings) < 2 or not pace:
            return None
        deadline = message.deadline
        sending_s = self._sending_s(pace)
        if sending_s < SMALL * (deadline - now):
            return None
        here = min(deadline, now + sending_s + round_trip_s)
        for other in message.siblings:
            expected_at = other.expected_at
            if expected_at < here and other is not message:
                overdue_at = expected_at + PATIENCE * (deadline - expected_at)
                if now < overdue_at:
                    return overdue_at
        return None

    def _sending_s(self, pace: float) -> float:
        return (len(self.again) + self._end - self.next) * self.message.symbol / pace


class SharedTurn(Turn):
    """One message on one of the paths that carry it together (`message/sharing.py`)."""

    __slots__ = ("_carried", "_newest", "_sharing")

    def __init__(self, message: MessageSymbols, sharing: Sharing, *, repeats: bool) -> None:
        """Join the paths that carry the message; `repeats`: repeat in spare time what the others carry."""
        super().__init__(message)
        self.next = self._end
        self._sharing = sharing
        self._carried = bytearray(len(message))
        """Symbols that left over this path."""
        self._newest = self._end - 1 if repeats else -1
        """Each later symbol has left over this path or arrived."""
        sharing.join(self)

    def take(self, most: int) -> tuple[int, int] | None:
        """Remove and return what was to be sent once more, or the next symbols that no other path has taken."""
        run = super().take(most) if self.again else None
        return self._note(self._sharing.take(most, self.message.needs) if run is None else run)

    def _note(self, run: tuple[int, int] | None) -> tuple[int, int] | None:
        if run is not None:
            self._carried[run[0] : sum(run)] = b"\1" * run[1]
        return run

    def repeat(self, most: int) -> tuple[int, int] | None:
        """Return the newest symbols that only other paths have carried so far, as `take` does; None: nothing is left.

        Among them may be some that no path has taken yet, while this one leaves them to the others.
        """
        carried, acked, last = self._carried, self.message.acked, self._newest
        while last >= 0 and (carried[last] or acked[last]):
            last -= 1
        self._newest = last
        most = min(most, self._sharing.repeats)
        if most <= 0 or last < 0 or self.message.over:
            return None
        first = last
        while first and last - first + 1 < most and not (carried[first - 1] or acked[first - 1]):
            first -= 1
        self._sharing.repeats -= last - first + 1
        return self._note((first, last - first + 1))

    @property
    def has_left(self) -> bool:
        """Whether it has nothing to send before the spare time."""
        return not self.again and not self._sharing.untaken

    def leave(self) -> tuple[int, ...]:
        """See `Turn.leave`."""
        return tuple(filter(self.message.needs, (*self.again, *self._sharing.leave(self))))

    def can_end_by(self, end: float, now: float, pace: float, round_trip_s: float) -> bool:
        """Return whether all paths together can have it answered before `end`; tell the others what this one can do."""
        self._sharing.offer(self, pace, round_trip_s, now)
        others, their_round_trip_s = self._sharing.others(self, now)
        if others:
            round_trip_s = min(round_trip_s, their_round_trip_s)
        return super().can_end_by(end, now, pace and pace + others, round_trip_s)

    def goes_on(self, _now: float, _pace: float, _round_trip_s: float) -> None:
        """Note that some of it has been taken to be sent."""
        self.begun = True

    def waits(self) -> None:
        """Tell the other paths not to rely on this one: something else goes first."""
        self._sharing.withdraw(self)

    def covered_until(self, now: float, pace: float, round_trip_s: float) -> float | None:
        """Return until when to leave it to the others, which would be done before a symbol sent here arrives."""
        others, their_round_trip_s = self._sharing.others(self, now)
        if not others or self.again:
            return None
        symbol = self.message.symbol
        others_s = self._sharing.untaken * symbol / others + their_round_trip_s
        return now + OFFER_S if others_s < round_trip_s + symbol / max(pace, 1.0) else None

    def _sending_s(self, pace: float) -> float:
        return (len(self.again) + self._sharing.untaken) * self.message.symbol / pace


PURGE_AT = 64
"""Entries that trigger the first search for messages that are over; the next one comes at twice their number."""
BEGUN = float("-inf")
"""Sort key of begun messages, before the other late ones."""
MAX_RUN = 64
"""Symbols in a run, as many as one offload has segments."""
MAX_RUN_BYTES = 65_000
"""Bytes in a run: the largest UDP payload, less a margin for other frames."""


class SymbolRun(NamedTuple):
    """Consecutive symbols of one message, to be sent in sequence."""

    message: MessageSymbols
    first: int
    symbols: int
    repeats: bool = False
    """Other paths carry them as well; they leave because there is time to spare."""


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

    __slots__ = ("_classes", "_entries", "_idle", "_order", "_pulls", "_purge_at", "expired", "rests_until")

    def __init__(self) -> None:
        self._classes = tuple(_Class() for _ in Priority)
        self._entries: dict[int, Turn] = {}
        self._idle: dict[int, SharedTurn] = {}
        """What may be repeated in spare time, or is left to other paths at present; among `_entries` as well."""
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
            self._insert(_turn(message, repeats=True))

    def resend(self, message: MessageSymbols, indices: Iterable[int]) -> None:
        """Queue these symbols of a message again, before its others."""
        entry = self._entries.get(message.number)
        if entry is None:
            entry = _turn(message, repeats=False)
            entry.next = len(message)
            self._insert(entry)
        elif self._idle.pop(message.number, None) is not None:
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
        """Drop messages that are over but have not come up yet, so that they hold no memory."""
        for each in self._classes:
            for heap in each.heaps:
                heap[:] = [item for item in heap if not item[2].message.over]
                heapq.heapify(heap)
            each.newest[:] = [item for item in each.newest if not item[2].message.over]
            heapq.heapify(each.newest)
        self._entries = {number: entry for number, entry in self._entries.items() if not entry.message.over}
        self._idle = {number: entry for number, entry in self._idle.items() if not entry.message.over}
        self._purge_at = max(PURGE_AT, 2 * len(self._entries))

    def take(
        self, now: float, budget: int, pace: float = 0.0, round_trip_s: float = 0.0, *, pulls: bool = True
    ) -> SymbolRun | None:
        """Remove and return what leaves next: at most about `budget` bytes, but at least one symbol.

        Messages that are over or expired are dropped on the way. `pace` (bytes a second, 0 when unknown) and
        `round_trip_s` tell which can still make their deadline. `pulls`: the path is up, and may take what others could
        carry as well.
        """
        self._pulls = pulls
        if self._idle and now >= self.rests_until:
            self._wake(now, pace, round_trip_s)
        waiting = [
            each for each in self._classes if any(each.heaps) and self._head(each, now, pace, round_trip_s) is not None
        ]
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
        return self._repeat(now, budget, round_trip_s) if self._idle else None

    def _wake(self, now: float, pace: float, round_trip_s: float) -> None:
        """Line up again what the other paths do not carry soon enough after all."""
        for number, entry in list(self._idle.items()):
            if entry.message.over:
                self._idle.pop(number, None)
                self._entries.pop(number, None)
            elif not entry.has_left and self._left_to_others(entry, now, pace, round_trip_s) is None:
                del self._idle[number]
                self._insert(entry)

    def _repeat(self, now: float, budget: int, round_trip_s: float) -> SymbolRun | None:
        """Return symbols that other paths carry, of the message that is most urgent and can still be in time."""

        def urgency(entry: SharedTurn) -> tuple[bool, float]:
            return entry.message.deadline <= now + round_trip_s, entry.message.deadline

        for entry in sorted(self._idle.values(), key=urgency):
            message = entry.message
            run = entry.repeat(_most_symbols(message, budget)) if message.expires > now else None
            if run is not None:
                return SymbolRun(message, *run, repeats=True)
            if entry.has_left:
                entry.leave()
                del self._idle[message.number], self._entries[message.number]
        self.rests_until = now + OFFER_S
        return None

    def _note_turn(self, waiting: list[_Class], chosen: _Class, symbols: int) -> None:
        higher = True
        for each in waiting:
            if each is chosen:
                each.passed_over = max(0, each.passed_over - SHARE * symbols) if each is not waiting[0] else 0
                higher = False
            elif not higher:
                each.passed_over = min(each.passed_over + symbols, SHARE * MAX_RUN)

    def _take(
        self, chosen: _Class, now: float, budget: int, most: int, pace: float, round_trip_s: float
    ) -> SymbolRun | None:
        while (heap := self._head(chosen, now, pace, round_trip_s)) is not None:
            entry = heap[0][2]
            message = entry.message
            run = entry.take(min(most, _most_symbols(message, budget)))
            if run is not None:
                entry.goes_on(now, pace, round_trip_s)
                if entry.has_left:
                    self._has_left(heap)
                elif heap is not chosen.fresh and heap is not chosen.covered:
                    heapq.heapreplace(heap, (BEGUN, heap[0][1], entry))
                return SymbolRun(message, *run)
            self._has_left(heap)
        return None

    def _has_left(self, heap: list[_Entry]) -> None:
        """Take out the head, of which nothing waits any more: drop it, or keep it to be repeated."""
        entry = heap[0][2]
        if isinstance(entry, SharedTurn):
            heapq.heappop(heap)
            self._idle[entry.message.number] = entry
        else:
            self._drop(heap)

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
                elif (until := self._left_to_others(entry, now, pace, round_trip_s)) is not None:
                    entry.waits()
                    heapq.heappop(heap)
                    if isinstance(entry, SharedTurn):
                        self._idle[message.number] = entry
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
            return now + OFFER_S
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
        del self._entries[heapq.heappop(heap)[2].message.number]

    def clear(self) -> list[tuple[MessageSymbols, tuple[int, ...]]]:
        """Empty the queue and return each message with its symbols that did not leave."""
        left = [(entry.message, entry.leave()) for entry in self._entries.values()]
        for each in self._classes:
            for heap in each.heaps:
                heap.clear()
            each.newest.clear()
        self._entries.clear()
        self._idle.clear()
        self._purge_at = PURGE_AT
        return [(message, indices) for message, indices in left if indices]


def _turn(message: MessageSymbols, *, repeats: bool) -> Turn:
    sharing = message.sharing
    return Turn(message) if sharing is None else SharedTurn(message, sharing, repeats=repeats)


def _most_symbols(message: MessageSymbols, budget: int) -> int:
    """Return how many of its symbols leave together within a budget in bytes; at least 1."""
    size = message.symbol + FRAGMENT_OVERHEAD_BYTES
    return max(1, min(MAX_RUN, budget // size, MAX_RUN_BYTES // size))
