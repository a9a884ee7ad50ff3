"""A race's outcomes as the sidecar would report them, in reports of half a second."""

from __future__ import annotations

import enum
import heapq
from dataclasses import dataclass
from typing import TYPE_CHECKING

from protos.histogram import Histogram
from protos.model import (
    Assignment,
    InterfaceName,
    JointReport,
    LatencyReport,
    NodeName,
    PathReport,
    Report,
    ServiceName,
)
from protos.size_class import size_class
from sidecar.core.copies import OBSERVED_ONE_IN

if TYPE_CHECKING:
    import random

    from bench.matcher.races import Probe, Race

REPORT_INTERVAL_S = 0.5
LIFETIME_S = 10.0
"""When a request that nobody answers is given up: the shortest default."""

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
    """Turns races into reports, no sooner than a sidecar could know of each outcome."""

    def __init__(self, deadline_s: float, rng: random.Random, *, size: int = 0) -> None:
        self._deadline_s = deadline_s
        self._size_class = size_class(size)
        self._rng = rng
        self._news: list[_News] = []
        """Latencies and when they are known."""
        self._judged: list[tuple[float, tuple[bool, bool], bool]] = []
        """When it is known which path has missed, which has, and whether the race is a full one."""
        self._probes: list[tuple[float, int, float]] = []

    def raced(self, race: Race) -> None:
        """A request went out over both paths."""
        missed = (race.latency_s[0] > self._deadline_s, race.latency_s[1] > self._deadline_s)
        full = not self._rng.randrange(OBSERVED_ONE_IN)
        over = max(race.latency_s) if full else min(race.latency_s)
        heapq.heappush(self._judged, (race.at_s + min(over, self._deadline_s), missed, full))
        if not full:
            return
        for path, (latency, processing) in enumerate(zip(race.latency_s, race.processing_s, strict=True)):
            # The answer is small: what is on its way for so long has not arrived at its server yet.
            if latency - processing > self._deadline_s and not missed[1 - path]:
                known, ended = self._deadline_s, _Ended.CALLED_OFF
            elif latency > LIFETIME_S:
                known, ended = LIFETIME_S, _Ended.LOST
            else:
                known, ended = latency, _Ended.ANSWERED
            heapq.heappush(self._news, _News(race.at_s + known, path, ended, known, processing))

    def probed(self, probe: Probe) -> None:
        """A probe went out."""
        heapq.heappush(self._probes, (probe.at_s + min(probe.rtt_s, PROBE_TIMEOUT_S), probe.path, probe.rtt_s))

    def take(self, now: float) -> Report:
        """The report of what is known by `now` and was not reported yet."""
        network, called_off, processing, rtts = ([Histogram(), Histogram()] for _ in range(4))
        judged, missed = [0, 0], [0, 0]
        together = both_missed = 0
        while self._judged and self._judged[0][0] <= now:
            _, misses, full = heapq.heappop(self._judged)
            together += 1
            both_missed += all(misses)
            for path in (0, 1) if full else ():
                judged[path] += 1
                missed[path] += misses[path]
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
                for path, pair in enumerate(PAIRS)
                if network[path].total or called_off[path].total or judged[path]
            ),
            tuple(PathReport(pair.interface, pair.server, True, rtts[path]) for path, pair in enumerate(PAIRS)),
            joints=(JointReport(SERVICE, *PAIRS, together, both_missed),) if together else (),
        )
