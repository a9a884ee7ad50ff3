"""Members that have something logged all the time: each has its share of lines, so that none fills the disk.

What happened is in the log of events too, which is bounded as a whole, and in the metrics.
"""

from __future__ import annotations

from dataclasses import dataclass

from controlplane.core.base.member_table import MemberTable
from protos.base.token_bucket import TokenBucket

LINES_BURST = 20.0
"""A day of somebody who looks for a mistake, in minutes."""

LINES_PER_S = 1.0 / 60.0
"""After that: 150 kB a day."""


@dataclass(slots=True)
class _Lines:
    share: TokenBucket
    left_out: int = 0
    """Since the last line on the member."""


class LineShare:
    """Counts the lines on each member. Times are monotonic seconds."""

    def __init__(self) -> None:
        self.shares = MemberTable(lambda now: _Lines(TokenBucket(rate=LINES_PER_S, burst=LINES_BURST, now=now)))
        self.left_out = 0
        """Of all members."""

    def take(self, member: str, now: float, of_all: TokenBucket | None = None) -> int | None:
        """How many lines on this member were left out since its last one; None: this one is to be left out too.

        `of_all`: a share of all members together, in lines of some kind; one beyond its own share takes nothing of it.
        """
        lines = self.shares.of(member, now)
        if lines.share.take(now) and (of_all is None or of_all.take(now)):
            left_out, lines.left_out = lines.left_out, 0
            return left_out
        lines.left_out += 1
        self.left_out += 1
        return None
