"""Whether a server that works on several requests at one moment does more for it.

Threads that share one processor, as those of a Python interpreter, have many requests in work and do no more than one
thread does. So now and then a server that is seen to work on several gets half as many for some answers. If its threads
are worth something, it does half as much then; if they share a processor, as much as before. The trial takes as many
answers as it needs to tell, as service times may vary, and only two such verdicts in a row count.
"""

from __future__ import annotations

import math

from sidecar.ros.service_times import ServiceTimes

LEAST_ANSWERS, MOST_ANSWERS = 16, 128
"""Of a trial. It ends as soon as the answers tell ..."""
SURE = 2.0
"""... by so many standard errors. If they do not, the server is believed to gain."""
FIRST_TRIAL_AFTER, LAST_TRIAL_AFTER = 64, 8192
"""Answers of several at once between two trials; they double each time. A trial costs half of the work it lasts."""
FIRST_IGNORED, LAST_IGNORED = 512, 8192
"""Answers for which overlaps do not count after they gained nothing; they double each time."""


class OverlapGain:
    """Trials with one server."""

    __slots__ = ("_after", "_doubted", "_fewer", "_ignored", "_more", "_next_ignored", "_overlap", "_since", "_until", "at_once")

    def __init__(self) -> None:
        self.at_once = 0
        """How many the server should have for a trial; 0: none is under way."""
        self._ignored = 0
        self._next_ignored = FIRST_IGNORED
        self._overlap = 1
        self._since = 0.0
        self._after = self._until = FIRST_TRIAL_AFTER
        self._doubted = False
        self._more = ServiceTimes(MOST_ANSWERS)
        self._fewer = ServiceTimes()

    @property
    def counts(self) -> bool:
        """Whether it is of use that the server works on several at once, as far as is known."""
        return not self._ignored

    def answered(self, sent_at: float, took_s: float, out: int, overlap: int) -> None:
        """One is answered that was sent as one of `out`, by a server that works on so many at once."""
        if self._ignored:
            self._ignored -= 1
        elif self.at_once:
            if sent_at > self._since and out >= self.at_once:
                self._fewer.add(took_s, out)
                self._judge()
        elif overlap > self._overlap or overlap == 1:
            self._overlap = overlap
            self._more = ServiceTimes(MOST_ANSWERS)
            self._until = self._after
        elif out >= overlap:
            self._more.add(took_s, out)
            self._until -= 1
            if self._until <= 0:
                self._overlap = overlap
                self.at_once = overlap // 2
                self._fewer = ServiceTimes()
                self._since = sent_at + took_s

    def _judge(self) -> None:
        """Compare what the server does for fewer and for more requests at once."""
        if self._fewer.count < LEAST_ANSWERS:
            return
        error = math.sqrt(self._more.variation / self._more.count + self._fewer.variation / self._fewer.count)
        if_none = self.at_once / self._overlap
        worth = self._more.rate / self._fewer.rate * if_none
        off = math.log(worth / math.sqrt(if_none))
        if abs(off) > SURE * error or self._fewer.count >= MOST_ANSWERS:
            self._conclude(doubted=off < -SURE * error)

    def _conclude(self, *, doubted: bool) -> None:
        if doubted and self._doubted:
            self._ignored = self._next_ignored
            self._next_ignored = min(2 * self._next_ignored, LAST_IGNORED)
        if doubted:
            self._after = FIRST_TRIAL_AFTER
        else:
            self._after = min(4 * self._after, LAST_TRIAL_AFTER)
        self._doubted = doubted
        self.at_once = 0
        self._overlap = 1
