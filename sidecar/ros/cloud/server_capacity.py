"""Finds how many requests a local server should have at once, from how long its answers take.

A request sent too early stands in the server's queue, first in, first out, where nothing more urgent can overtake it.
One sent too late lets the server idle for the way to the sidecar and back. So the number follows from Little's law:
with `n` requests at the server at a time that take `r` seconds each, where a request alone takes `a`, it does the work
of `n * a / r` requests alone. For a server that takes one after the other, that is 1, or a little more where the way
there is part of `a`; for one with four threads it is 4. As long as it keeps pace with `n`, twice as many are tried.

Service times may vary, so means are compared, and only within their confidence: where times vary much, the law says
little. Then answers out of order prove how many were in work at once (`request_overlap.py`). One more than that may be
there, unless that many gain nothing because their threads share one processor (`overlap_gain.py`).

`a` is measured when requests are too few to meet. Where no overlap tells more, the server is emptied to measure it now
and then, and when it seems to have fallen behind: either its work became longer, or its threads fewer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from plr.sidecar.ros.cloud.overlap_gain import OverlapGain
from plr.sidecar.ros.cloud.request_overlap import RequestOverlap
from plr.sidecar.ros.cloud.service_times import ServiceTimes

FIRST_LIMIT = 2
"""One in work and one ready when that is done."""
SAFE_SIZE = 8
"""Requests that a server's queue surely holds: rmw's default depth is 10, but the server may have other clients."""
MOST_AT_ONCE = 32
"""Also the depth of DDS's queues for requests and answers, and so the cost of a killed server. Until its lease ends,
about 20 s, no request counts as delivered to all. DDS then keeps this many buffers until the client is destroyed, each
as long as the longest of those requests."""
WAITING_S = 0.005
"""Work that may wait at the server so that it does not idle for the way to the sidecar and back: on a busy host, a few
times the 0.2 to 0.5 ms of a call. At least one request waits ..."""
LONG_S = 0.1
"""... unless a request alone takes longer than this: then the server idles for a few per cent of its time at most, and
the order of requests is worth more."""
KEEPS_PACE = 0.4
"""While no more than this many requests surely wait at the server, more at once are tried: twice as many until it first
falls behind, then one more."""
ROUNDING = 0.25
"""Tolerance: for a server that works on one at a time, the law may give a little more by chance."""
LEAST_ROUND = 4
"""Minimum answers to judge the limit by, or the limit itself if higher; twice that once the server fell behind."""
ALONE_KEPT = 8
"""Each request alone has at least a weight of one over this in their mean."""
SURER = 4
"""Rounds to wait for if they may show that the limit is right."""
LEAST_ALONE = 4
"""Requests alone to measure once their variation matters."""
SURE = 2.0
"""Standard errors that a mean may be off by."""
USUAL_WEIGHT = 0.125
"""Weight of the newest answer in the mean time of all answers."""
ALONE_FOR_S = 0.02
"""To measure the time alone, at least one request is sent alone, until they took this long together."""
STALE_AFTER, STALE_S, STALE_TIMES = 32, 1.0, 16
"""Age of the time alone, in answers, seconds and multiples of itself, after which it may have changed. It is then
measured again before the limit is lowered because of it. The multiple bounds what that costs."""
ALONE_AGAIN_S = 10.0
FIRST_ROUNDS, MOST_ROUNDS = 8, 64
"""The time alone is measured again after ALONE_AGAIN_S and this many answers per request at once, doubled each time.
That costs a server with many threads a few per cent of its work, and one that takes one after the other nothing."""
FIRST_TRY_AFTER, LAST_TRY_AFTER = 4, 64
"""Answers to single requests after which two at once are tried again; doubled each time."""


@dataclass(slots=True)
class _Sent:
    at: float
    out: int
    """Requests that the server may have had by then, this one included."""
    alone: bool
    """Whether nothing else was there with it. Overtaken requests, which may be in work for long, do not count."""


class ServerCapacity:
    """What is known of one server. Request numbers ascend; times are in seconds."""

    __slots__ = (
        "_alone",
        "_alone_at",
        "_answers",
        "_by_times",
        "_calibrated_before",
        "_calibrated_s",
        "_calibrating",
        "_fell_behind",
        "_gain",
        "_limit",
        "_only",
        "_overlap",
        "_round",
        "_rounds",
        "_sent",
        "_singles",
        "_try_after",
        "usual_s",
    )

    def __init__(self, first: int = FIRST_LIMIT) -> None:
        self._limit = first
        self._alone = ServiceTimes(ALONE_KEPT)
        """Time that a request alone takes, the hop included."""
        self.usual_s = 0.0
        """Time that a request usually takes now, the wait in the server's queue included; 0 if not known yet."""
        self._overlap = RequestOverlap()
        self._gain = OverlapGain()
        self._by_times = False
        """Whether the limit rests on service times, as overlaps prove less."""
        self._fell_behind = False
        self._calibrating = True
        self._calibrated_s = 0.0
        self._calibrated_before = False
        self._alone_at = 0.0
        self._answers = 0
        """Answers since a request was last alone."""
        self._round = ServiceTimes()
        self._rounds = FIRST_ROUNDS
        self._singles = 0
        """Answers since the limit became 1."""
        self._try_after = FIRST_TRY_AFTER
        self._sent: dict[int, _Sent] = {}
        self._only: int | None = None
        """The request that is alone at the server."""

    @property
    def limit(self) -> int:
        """Number of requests that the server should have at once, overtaken ones included."""
        return 1 if self._calibrating else self._gain.at_once or self._limit

    @property
    def _most(self) -> int:
        """Highest useful limit: besides overtaken requests, no more are sent than a queue surely holds."""
        return min(self.overlap - 1 + SAFE_SIZE, MOST_AT_ONCE)

    @property
    def overlap(self) -> int:
        """The most requests that were recently in work at once, as proved by answers out of order."""
        return self._overlap.most

    @property
    def overtaken(self) -> int:
        """Number of requests in work although later ones are answered."""
        return self._overlap.overtaken

    @property
    def proved(self) -> int:
        """Number of requests that it usefully works on at once, at least."""
        return self._gain.of_use(self.overlap)

    def given_up(self, number: int) -> None:
        """Note that this request is no longer awaited."""
        self._sent.pop(number, None)
        self._overlap.given_up(number)

    def sent(self, number: int, unseen: int, now: float) -> None:
        """Note that a request was sent; with it the server has `unseen` that it was not seen to have taken."""
        if self._only is not None and self._only in self._sent:
            self._sent[self._only].alone = False
        self._only = number if unseen == 1 else None
        out = unseen + self.overtaken
        self._sent[number] = _Sent(now, out, alone=unseen == 1)
        self._gain.sent(out, now)
        if len(self._sent) > 2 * MOST_AT_ONCE:
            del self._sent[next(iter(self._sent))]

    def answered(self, number: int, now: float) -> None:
        """Note that the server answered one of them; a second answer does not count."""
        sent = self._sent.pop(number, None)
        if sent is None:
            return
        self._overlap.answered(number, self._sent)
        took_s = max(now - sent.at, 1e-6)
        self.usual_s += (took_s - self.usual_s) * (USUAL_WEIGHT if self.usual_s else 1.0)
        self._answers += 1
        in_trial = self._gain.at_once > 0
        if not self._calibrating:
            self._gain.answered(took_s, sent.out, self.overlap, now)
        if sent.alone:
            self._was_alone(took_s, now)
        elif sent.out > 1 and not self._calibrating and not in_trial:
            self._round.add(took_s, sent.out)
            if self._round.count >= self._least_round:
                self._judge(now)
        if 1 < self.proved >= self._limit < self._most:
            self._set_limit(self.proved + 1)

    @property
    def _least_round(self) -> int:
        return max(LEAST_ROUND, self._limit) * (2 if self._fell_behind else 1)

    def _was_alone(self, took_s: float, now: float) -> None:
        self._alone.add(took_s)
        self._alone_at = now
        self._answers = 0
        if self._calibrating:
            self._calibrated_s += took_s
            few = self._calibrated_before and self._alone.count < LEAST_ALONE
            self._calibrating = few or self._calibrated_s < ALONE_FOR_S
            return
        if self._limit == 1:
            self._singles += 1
            if self._singles >= self._try_after:
                self._try_after = min(2 * self._try_after, LAST_TRY_AFTER)
                self._set_limit(FIRST_LIMIT)

    def _judge(self, now: float) -> None:
        """Set the limit by the last round of requests that were not alone."""
        out = self._round.out
        at_least = self._at_least()
        at_once = min(max(at_least, self.proved), out)
        self._by_times = at_least > self.proved
        if out - at_once > KEEPS_PACE:
            self._fell_behind = True
            wanted = self._wanted(at_once)
            if out <= self._limit - 1:
                wanted = max(wanted, min(math.ceil(out), self._limit))  # never more were there, so little is known
            surer = self._round.count < SURER * self._least_round
            if surer and wanted < min(self._limit, self._wanted(min(self._round.rate * self._alone.mean_s, out))):
                return
            if self._alone.count < LEAST_ALONE and self._wanted(self._round.rate * self._alone.mean_s) > wanted:
                self._calibrate()
            elif wanted < self._limit and self._needs_times and self._is_stale(now):
                self._calibrate_afresh()
            else:
                self._set_limit(wanted)
        elif at_least > out + KEEPS_PACE and self._is_stale(now):
            self._calibrate_afresh()  # more than were there: a request alone now takes less
        elif out > self._limit - 1:
            more = self._limit + 1 if self._fell_behind else 2 * self._limit
            self._set_limit(min(more, self._most))
        else:
            self._set_limit(self._limit)
        if not self._needs_times:
            return
        if now - self._alone_at >= ALONE_AGAIN_S and self._answers >= self._rounds * self._limit:
            self._rounds = min(2 * self._rounds, MOST_ROUNDS)
            self._calibrate()

    def _at_least(self) -> float:
        """Return how many requests alone the server surely does the work of at once."""
        either = max(self._alone.variation, self._round.variation)  # a few answers may not show how much they vary
        alone = self._alone.variation if self._alone.count >= LEAST_ALONE else either
        error = math.sqrt(alone / self._alone.count + either / self._round.count)
        return self._round.rate * self._alone.mean_s * math.exp(-SURE * error)

    @property
    def _needs_times(self) -> bool:
        """Whether the time that a request alone takes matters."""
        return self._by_times or self.proved == 1

    def _wanted(self, at_once: float) -> int:
        """Return how many requests to have at a server that does the work of `at_once` requests."""
        wanted = max(1, math.ceil(at_once - ROUNDING))
        if at_once < self._round.rate * LONG_S:
            wanted += math.ceil(self._round.rate * WAITING_S)
        if self.proved > 1:
            wanted = max(wanted, self.proved + 1)
        return min(wanted, self._most)

    def _is_stale(self, now: float) -> bool:
        age_s = now - self._alone_at
        before_this_round = self._answers - self._round.count - self._limit
        return before_this_round > STALE_AFTER and age_s > max(STALE_S, STALE_TIMES * self._alone.mean_s)

    def _calibrate(self) -> None:
        self._calibrated_before = True
        self._calibrating = True
        self._calibrated_s = 0.0
        self._set_limit(self._limit)

    def _calibrate_afresh(self) -> None:
        self._alone = ServiceTimes(ALONE_KEPT)
        self._calibrate()

    def _set_limit(self, limit: int) -> None:
        self._limit = limit
        self._singles = 0
        self._round = ServiceTimes()
