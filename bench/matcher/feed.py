"""Reports a race's outcomes as the sidecar would, in reports of half a second."""

from __future__ import annotations

import enum
import heapq
import itertools
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

from plr.protos.base.histogram import Histogram
from plr.protos.base.size_class import size_class
from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
from plr.protos.model.mapping import Assignment
from plr.protos.model.report import JointReport, LatencyReport, PathReport, Report
from plr.sidecar.core.base.request_id import OBSERVED_ONE_IN

if TYPE_CHECKING:
    import random
    from collections.abc import Sequence

    from bench.matcher.races import Probe, Race

REPORT_INTERVAL_S = 0.5
LIFETIME_S = 10.0
"""Time after which an unanswered request is given up: the shortest default."""

ROBOT = NodeName("robot")
SERVICE = ServiceName("/detect")
PAIRS = (
    Assignment(InterfaceName("a"), NodeName("cloud-a")),
    Assignment(InterfaceName("b"), NodeName("cloud-b")),
)
PROBE_TIMEOUT_S = 1.0


class _Ended(enum.IntEnum):
    ANSWERED = 0
    CALLED_OFF = 1
    LOST = 2


@dataclass(frozen=True, slots=True, order=True)
class _News:
    at_s: float
    path: int
    ended: _Ended
    after_s: float
    processing_s: float


class Reporter:
    """Turns races into reports, no sooner than a sidecar could know of each outcome. Paths are numbered as `pairs`."""

    def __init__(
        self, deadline_s: float, rng: random.Random, *, size: int = 0, pairs: tuple[Assignment, ...] = PAIRS
    ) -> None:
        self._deadline_s = deadline_s
        self._size_class = size_class(size)
        self._rng = rng
        self._pairs = pairs
        self._news: list[_News] = []
        """Latencies, and when they become known."""
        self._judged: list[tuple[float, int, tuple[tuple[int, bool], ...], bool]] = []
        """When it becomes known which paths missed, a number to tell races apart, each path and whether it missed, and
        whether the race is a full one."""
        self._raced = 0
        self._probes: list[tuple[float, int, float]] = []

    def raced(self, race: Race, carried: Sequence[int] | None = None, *, full: bool | None = None) -> None:
        """Note a request sent over these paths (by default all of them).

        With `full`, none of its copies is cancelled before the deadline; by default that is left to chance, as in a
        sidecar. A single copy is always measured.
        """
        paths = range(len(self._pairs)) if carried is None else carried
        if full is None:
            full = not self._rng.randrange(OBSERVED_ONE_IN)
        full = full or len(paths) < 2
        latencies = [race.latency_s[path] for path in paths]
        missed = tuple((path, race.latency_s[path] > self._deadline_s) for path in paths)
        over = max(latencies) if full else min(latencies)
        self._raced += 1
        heapq.heappush(self._judged, (race.at_s + min(over, self._deadline_s), self._raced, missed, full))
        won = any(not late for _, late in missed)
        for path, late in missed if full else ():
            latency, processing = race.latency_s[path], race.processing_s[path]
            # The answer is small: a request under way for this long has not reached its server yet.
            if late and won and latency - processing > self._deadline_s:
                known, ended = self._deadline_s, _Ended.CALLED_OFF
            elif latency > LIFETIME_S:
                known, ended = LIFETIME_S, _Ended.LOST
            else:
                known, ended = latency, _Ended.ANSWERED
            heapq.heappush(self._news, _News(race.at_s + known, path, ended, known, processing))

    def rescued(self, race: Race, path: int) -> None:
        """Note a copy sent over this path after the deadline without an answer: it started late, so it is not judged.

        Its latency is assumed to be what the request itself would have had there.
        """
        latency = race.latency_s[path]
        if latency <= LIFETIME_S - self._deadline_s:
            known_at = race.at_s + self._deadline_s + latency
            heapq.heappush(self._news, _News(known_at, path, _Ended.ANSWERED, latency, race.processing_s[path]))

    def probed(self, probe: Probe) -> None:
        """Note a probe that was sent."""
        heapq.heappush(self._probes, (probe.at_s + min(probe.rtt_s, PROBE_TIMEOUT_S), probe.path, probe.rtt_s))

    def take(self, now: float) -> Report:
        """Return the report of what is known by `now` and not reported yet."""
        network, called_off, processing, rtts = ([Histogram() for _ in self._pairs] for _ in range(4))
        judged, missed, joints = self._outcomes(now)
        while self._news and self._news[0].at_s <= now:
            news = heapq.heappop(self._news)
            if news.ended is _Ended.CALLED_OFF:
                called_off[news.path].record(news.after_s)
            elif news.ended is _Ended.LOST:
                network[news.path].record_lost()
            else:
                network[news.path].record(news.after_s - news.processing_s)
                processing[news.path].record(news.processing_s)
        while self._probes and self._probes[0][0] <= now:
            _, path, rtt = heapq.heappop(self._probes)
            if rtt > PROBE_TIMEOUT_S:
                rtts[path].record_lost()
            else:
                rtts[path].record(rtt)
        return Report(
            tuple(
                LatencyReport(
                    pair.interface,
                    pair.server,
                    SERVICE,
                    self._size_class,
                    network[path],
                    called_off[path],
                    processing[path],
                    judged[path],
                    missed[path],
                )
                for path, pair in enumerate(self._pairs)
                if network[path].total or called_off[path].total or judged[path]
            ),
            tuple(PathReport(pair.interface, pair.server, True, rtts[path]) for path, pair in enumerate(self._pairs)),
            joints=joints,
        )

    def _outcomes(self, now: float) -> tuple[Counter[int], Counter[int], tuple[JointReport, ...]]:
        """Return requests and misses by path, and by pair of paths."""
        judged: Counter[int] = Counter()
        missed: Counter[int] = Counter()
        together: Counter[tuple[int, int]] = Counter()
        both_missed: Counter[tuple[int, int]] = Counter()
        while self._judged and self._judged[0][0] <= now:
            _, _, outcomes, full = heapq.heappop(self._judged)
            for path, late in outcomes if full else ():
                judged[path] += 1
                missed[path] += late
            for (one, one_late), (other, other_late) in itertools.combinations(sorted(outcomes), 2):
                if full or len(outcomes) == 2:
                    together[one, other] += 1
                    both_missed[one, other] += one_late and other_late
        joints = tuple(
            JointReport(SERVICE, self._pairs[one], self._pairs[other], count, both_missed[one, other])
            for (one, other), count in together.items()
        )
        return judged, missed, joints
