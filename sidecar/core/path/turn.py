"""A message's turn on one path: which of its symbols leave next there, and whether they can still be in time.

A request's copies on several paths are in one race (`OutboundMessage.siblings`). The path that sends one says when it
expects the answer. Until that is overdue, the others need not send the same: as long as something else waits there,
they send that. So where the load is more than one carrier bears, carriers share it instead of all sending the same, and
where it is not, all copies leave at once. Those of small requests always do.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from sidecar.core.base.timers import NEVER

if TYPE_CHECKING:
    from sidecar.core.message.outbound import OutboundMessage

HASTE = 1.25
"""A message that has not begun to leave is late when this many times its sending time does not fit any more: what is
begun should also be finished."""
PATIENCE = 0.5
"""An answer that another path expects is overdue when this part of the time from then to the deadline is over: there
should be time left for this one."""

SMALL = 0.1
"""What takes less than this part of the time that is left is sent at once anyway: others hardly wait for it."""


class Turn:
    """One message on one path."""

    __slots__ = ("again", "begun", "message", "next")

    def __init__(self, message: OutboundMessage) -> None:
        self.message = message
        self.next = 0
        self.again: deque[int] = deque()
        """Symbols to be sent once more."""
        self.begun = False
        """Some of what is to be sent has left."""

    def take(self, most: int) -> tuple[int, int] | None:
        """Remove and return the next consecutive symbols as (first, count), `most` of them; None when none is left."""
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
        last = self.message.symbols
        first = self.next
        while first < last and not needs(first):
            first += 1
        end = first
        limit = min(last, first + most)
        while end < limit and needs(end):
            end += 1
        self.next = end
        return (first, end - first) if end > first else None

    def remaining(self) -> tuple[int, ...]:
        """The symbols that have not left and still have to."""
        return tuple(filter(self.message.needs, (*self.again, *range(self.next, self.message.symbols))))

    def can_end_by(self, end: float, now: float, pace: float, round_trip_s: float) -> bool:
        """Whether its last symbol can be answered before `end` at this pace (bytes a second; 0: unknown)."""
        if not pace:
            return now < end
        sending_s = self._sending_s(pace) * (1.0 if self.begun else HASTE)
        return now + sending_s + round_trip_s < end

    def goes_on(self, now: float, pace: float, round_trip_s: float) -> None:
        """Some of it has been taken to be sent: tell its siblings when to expect the answer."""
        self.begun = True
        self.message.expected_at = now + self._sending_s(pace) + round_trip_s if pace else NEVER

    def waits(self) -> None:
        """Something else goes first: nothing is to be expected of it here."""
        self.message.expected_at = NEVER

    def covered_until(self, now: float, pace: float, round_trip_s: float) -> float | None:
        """Until when to leave the request to another path that expects the answer in time, and sooner than this one."""
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
        return (len(self.again) + self.message.symbols - self.next) * self.message.symbol / pace
