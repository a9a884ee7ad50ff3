"""Represents one message on one path: which of its symbols leave next, and whether it can still be in time."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, NamedTuple

from plr.sidecar.core.base.timers import NEVER
from plr.sidecar.core.wire.frame import FRAGMENT_OVERHEAD_BYTES

if TYPE_CHECKING:
    from plr.sidecar.core.message.sharing import Sharing
    from plr.sidecar.core.message.symbols import MessageSymbols

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


HASTE = 1.25
"""A message that has not begun to leave is late when this many times its sending time no longer fits: a message that
begins should also finish."""
PATIENCE = 0.5
"""An answer that another path expects is overdue after this share of the time between the expected answer and the
deadline: there should be time left for this path."""

LOOK_AGAIN_S = 0.02
"""What is left to paths that share it is looked at again after this time (s)."""
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

    __slots__ = ("_carried", "_newest", "_sharing", "declined", "listed")

    def __init__(self, message: MessageSymbols, sharing: Sharing, *, repeats: bool) -> None:
        """Join the paths that carry the message; `repeats`: repeat in spare time what the others carry."""
        super().__init__(message)
        self.next = self._end
        self._sharing = sharing
        self._carried = bytearray(len(message))
        """Symbols that left over this path."""
        self._newest = self._end - 1 if repeats else -1
        """Each later symbol has left over this path or arrived."""
        self.listed = False
        """Whether it is in the list of what may be repeated."""
        self.declined = False
        """Whether it is in the list of what is left to others and looked at again."""
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
        here_s = round_trip_s + (symbol / pace if pace else 0.0)  # a path of unknown pace has to try
        return now + LOOK_AGAIN_S if others_s < here_s else None

    def _sending_s(self, pace: float) -> float:
        return (len(self.again) + self._sharing.untaken) * self.message.symbol / pace


def turn_of(message: MessageSymbols, *, repeats: bool) -> Turn:
    """Return the message's turn on one more path; `repeats` as in `SharedTurn`."""
    sharing = message.sharing
    return Turn(message) if sharing is None else SharedTurn(message, sharing, repeats=repeats)


def most_symbols(message: MessageSymbols, budget: int) -> int:
    """Return how many of its symbols leave together within a budget in bytes; at least 1."""
    size = message.symbol + FRAGMENT_OVERHEAD_BYTES
    return max(1, min(MAX_RUN, budget // size, MAX_RUN_BYTES // size))
