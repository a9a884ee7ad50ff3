"""Limits members that cause log lines all the time: each has its share, so that none fills the disk.

What happened is also in the log of events, which is bounded as a whole, and in the metrics.
"""

from __future__ import annotations

from dataclasses import dataclass

from plr.controlplane.core.base.member_table import MemberTable
from plr.protos.base.token_bucket import TokenBucket

LINES_BURST = 20.0
"""A day of somebody who looks for a mistake, in minutes."""

LINES_PER_S = 1.0 / 60.0
"""Rate after that: 150 kB a day."""


@dataclass(slots=True)
class _Lines:
    share: TokenBucket
    left_out: int = 0
    """Lines left out since the last line on the member."""


class LineShare:
    """Counts the lines on each member. Times are monotonic seconds."""

    def __init__(self) -> None:
        self.shares = MemberTable(lambda now: _Lines(TokenBucket(rate=LINES_PER_S, burst=LINES_BURST, now=now)))
        self.left_out = 0
        """Lines left out, of all members."""

    def take(self, member: str, now: float, of_all: TokenBucket | None = None) -> int | None:
        """Return how many lines on this member were left out since its last one; None: leave out this one too.

        `of_all` is a share of all members together, in lines of some kind; a line beyond its own share takes nothing of
        it.
        """
        lines = self.shares.of(member, now)
        if lines.share.take(now) and (of_all is None or of_all.take(now)):
            left_out, lines.left_out = lines.left_out, 0
            return left_out
        lines.left_out += 1
        self.left_out += 1
        return None
