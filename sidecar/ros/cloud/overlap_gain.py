"""Finds out whether a server that works on several requests at once gains anything from it.

Threads that share one processor, like those of a Python interpreter, have many requests in work but do no more than one
thread. So now and then a server that is seen to work on several gets a quarter as many for some answers. If its threads
are worth something, it then does a quarter of the work; if they share a processor, as much as before. As service times
may vary, a trial takes as many answers as the verdict needs, and only two verdicts of no gain in a row count.

Rates of answers are compared, not service times: the longest requests are not answered before the trial ends.
"""

from __future__ import annotations

import math

from plr.sidecar.ros.cloud.service_times import ServiceTimes

FEWER = 4
"""A trial divides the requests in work at once by this."""
LEAST_ANSWERS, MOST_ANSWERS = 16, 128
"""Length of a trial in answers. It ends as soon as the answers tell ..."""
SURE = 2.0
"""... by this many standard errors. If they never do, the server is taken to gain."""
STEP = 1.25
"""If the server works on this many times more, its earlier rate is no measure."""
FIRST_TRIAL_AFTER, LAST_TRIAL_AFTER = 64, 8192
"""Answers with several requests at once between two trials; four times as many after each that showed a gain."""
FIRST_IGNORED, LAST_IGNORED = 512, 8192
"""Answers during which overlaps do not count after they gained nothing; doubled each time."""


class OverlapGain:
    """The trials of one server. Times are in seconds."""

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
        """Requests that the server should have during a trial; 0 if none is under way."""
        self._before = ServiceTimes(MOST_ANSWERS)
        """Service times of requests sent when the server had as many as it works on."""
        self._overlap = 1
        """Requests that it worked on at once then."""
        self._after = self._until = FIRST_TRIAL_AFTER
        self._since = math.inf
        """When the server's requests came down to `at_once`."""
        self._answers = 0
        """Answers since then."""
        self._doubted = False
        self._ignored = 0
        self._next_ignored = FIRST_IGNORED

    def of_use(self, overlap: int) -> int:
        """Return how many requests at once are known to be useful at a server that works on `overlap`."""
        if self._ignored:
            return 1
        return min(overlap, FEWER) if self._doubted else overlap

    def sent(self, out: int, now: float) -> None:
        """Note that a request was sent as one of `out`."""
        if out < self.at_once or self._since > now:
            self._since = now
            self._answers = 0

    def answered(self, took_s: float, out: int, overlap: int, now: float) -> None:
        """Note an answer to a request sent as one of `out`, by a server that works on `overlap` at once."""
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
        """Compare the server's rate with fewer requests at once to its rate before."""
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
