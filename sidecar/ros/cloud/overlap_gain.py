"""Whether a server that works on several requests at one moment does more for it.

Threads that share one processor, as those of a Python interpreter, have many requests in work and do no more than one
thread does. So now and then a server that is seen to work on several gets a quarter as many for some answers. If its
threads are worth something, it does a quarter as much then; if they share a processor, as much as before. The trial
takes as many answers as it needs to tell, as service times may vary, and only two such verdicts in a row count.

Answers by time are compared, not what requests took: those that take longest are not answered before the trial ends.
"""

from __future__ import annotations

import math

from sidecar.ros.cloud.service_times import ServiceTimes

FEWER = 4
"""A trial is with one such part of what is in work at once."""
LEAST_ANSWERS, MOST_ANSWERS = 16, 128
"""Of a trial. It ends as soon as the answers tell ..."""
SURE = 2.0
"""... by so many standard errors. If they do not, the server is believed to gain."""
STEP = 1.25
"""When the server works on so many times more, what it did before is no measure."""
FIRST_TRIAL_AFTER, LAST_TRIAL_AFTER = 64, 8192
"""Answers of several at once between two trials; four times as many after each that showed a gain."""
FIRST_IGNORED, LAST_IGNORED = 512, 8192
"""Answers for which overlaps do not count after they gained nothing; they double each time."""


class OverlapGain:
    """Trials with one server. Times are seconds."""

    __slots__ = (
        "_after",
        "_answers",
        "_before",
        "_doubted",
        "_ignored",
        "_next_ignored",
        "_overlap",
        "_since",
        "_until",
        "at_once",
    )

    def __init__(self) -> None:
        self.at_once = 0
        """How many the server should have for a trial; 0: none is under way."""
        self._before = ServiceTimes(MOST_ANSWERS)
        """Of those that were sent when the server had as many as it works on."""
        self._overlap = 1
        """How many it worked on."""
        self._after = self._until = FIRST_TRIAL_AFTER
        self._since = math.inf
        """When the server came down to that many."""
        self._answers = 0
        """Since then."""
        self._doubted = False
        self._ignored = 0
        self._next_ignored = FIRST_IGNORED

    def of_use(self, overlap: int) -> int:
        """How many at once it is of use to have in work at a server that works on so many, as far as is known."""
        if self._ignored:
            return 1
        return min(overlap, FEWER) if self._doubted else overlap

    def sent(self, out: int, now: float) -> None:
        """One was sent as one of so many."""
        if out < self.at_once or self._since > now:
            self._since = now
            self._answers = 0

    def answered(self, took_s: float, out: int, overlap: int, now: float) -> None:
        """One is answered that was sent as one of `out`, by a server that works on so many at once."""
        overlap = self.of_use(overlap)
        if self._ignored:
            self._ignored -= 1
        elif self.at_once:
            self._answers += self._since < now
            if self._answers >= LEAST_ANSWERS:
                self._judge(now)
        elif overlap > STEP * self._overlap or overlap == 1:
            self._overlap = overlap
            self._before = ServiceTimes(MOST_ANSWERS)
            self._until = self._after
        elif out >= overlap:
            self._before.add(took_s, out)
            self._until -= 1
            if self._until <= 0:
                self._overlap = overlap
                self.at_once = max(overlap // FEWER, 1)
                self._since = math.inf
                self._answers = 0

    def _judge(self, now: float) -> None:
        """Compare what the server does for fewer requests at once with what it did before."""
        error = math.sqrt(self._before.variation * (1 / self._before.count + 1 / self._answers))
        if_none = self.at_once / self._overlap
        worth = self._before.rate * (now - self._since) / self._answers * if_none
        off = math.log(worth / math.sqrt(if_none))
        if abs(off) <= SURE * error and self._answers < MOST_ANSWERS:
            return
        doubted = off < -SURE * error
        if doubted and self._doubted:
            self._ignored = self._next_ignored
            self._next_ignored = min(2 * self._next_ignored, LAST_IGNORED)
        self._after = FIRST_TRIAL_AFTER if doubted else min(4 * self._after, LAST_TRIAL_AFTER)
        self._doubted = doubted
        self.at_once = 0
        self._overlap = 1
