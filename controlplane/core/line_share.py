"""Members that have something logged all the time: each has its share of lines, so that none fills the disk.

What happened is in the log of events too, which is bounded as a whole, and in the metrics.
"""

from __future__ import annotations

from collections import OrderedDict

from protos.token_bucket import TokenBucket

LINES_BURST = 20.0
"""A day of somebody who looks for a mistake, in minutes."""

LINES_PER_S = 1.0 / 60.0
"""After that: 150 kB a day."""

MAX_MEMBERS = 8192
"""Members whose lines are counted, the one that was logged longest ago goes: twice those that can be registered."""


class LineShare:
    """Counts the lines on each member. Times are monotonic seconds."""

    def __init__(self) -> None:
        self._shares: OrderedDict[str, TokenBucket] = OrderedDict()
        self._left_out: dict[str, int] = {}
        """Since the last line on the member, if any was."""
        self.left_out = 0
        """Of all members."""
        self.forgotten = 0

    def take(self, member: str, now: float, of_all: TokenBucket | None = None) -> int | None:
        """How many lines on this member were left out since its last one; None: this one is to be left out too.

        `of_all`: a share of all members together, in lines of some kind; one beyond its own share takes nothing of it.
        """
        share = self._shares.get(member)
        if share is None:
            share = self._shares[member] = TokenBucket(rate=LINES_PER_S, burst=LINES_BURST, now=now)
            if len(self._shares) > MAX_MEMBERS:
                forgotten, _ = self._shares.popitem(last=False)
                self._left_out.pop(forgotten, None)
                self.forgotten += 1
        self._shares.move_to_end(member)
        if share.take(now) and (of_all is None or of_all.take(now)):
            return self._left_out.pop(member, 0)
        self._left_out[member] = self._left_out.get(member, 0) + 1
        self.left_out += 1
        return None
