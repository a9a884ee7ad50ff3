"""Remembers how each pair of an interface and a server answered recently.

`PathPaces` keeps the current latency of a pair, `PathRecords` the outcomes of its last copies.

Pace: each pair has two averages. The current one moves halfway to each answer; the usual one moves slowly. The current
one fades into the usual one. A copy that has been awaited for longer than both shows that its pair is slow now, long
before it is answered.

Records: a copy that was called off is known to have taken at least that long. For a quantile below that moment this is
as good as the latency itself, and no hedge is sent before the quantile it waits for. So the delay of hedges stays right
although most slow copies are called off. Which pair misses least follows from measured requests only
(`Request.observed`).
"""

from __future__ import annotations

import math
from collections import OrderedDict, deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from plr.sidecar.core.robot.request.request import CopyState

if TYPE_CHECKING:
    from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
    from plr.sidecar.core.base.values import PathId
    from plr.sidecar.core.robot.request.request import Copy, Request
    from plr.sidecar.core.seam.stats import EngineStats
    from plr.sidecar.core.transfer.routes import Routes

MAX_PACES = 4096
"""Pairs remembered, each for one service; beyond that the least recently used one goes."""
PRESENT_GAIN = 0.5
USUAL_GAIN = 1 / 16
FADE_S = 2.0
"""Half-life of the gap between current and usual latency: a bad spot on a road lasts about this long."""


class _Key(NamedTuple):
    service: ServiceName
    interface: InterfaceName
    server: NodeName


@dataclass(slots=True)
class _Pace:
    present_s: float
    usual_s: float
    processing_s: float
    noted_at: float

    def expected_s(self, now: float) -> float:
        faded = math.pow(0.5, (now - self.noted_at) / FADE_S)
        return self.usual_s + (self.present_s - self.usual_s) * faded


class PathPaces:
    """The pace of each pair, by service: requests of a service are assumed to be alike in size."""

    def __init__(self, routes: Routes, stats: EngineStats) -> None:
        self._routes = routes
        self._stats = stats
        self._paces: OrderedDict[_Key, _Pace] = OrderedDict()

    def answered(self, service: ServiceName, path: PathId, latency_s: float, processing_s: float, now: float) -> None:
        """Note a copy that was answered `latency_s` after it was sent, `processing_s` of which the server took."""
        key = _Key(service, path.interface, path.peer)
        pace = self._paces.get(key)
        if pace is None:
            self._paces[key] = _Pace(latency_s, latency_s, processing_s, now)
            if len(self._paces) > MAX_PACES:
                self._paces.popitem(last=False)
                self._stats.dropped["path_paces_full"] += 1
            return
        self._paces.move_to_end(key)
        expected_s = pace.expected_s(now)
        pace.present_s = expected_s + PRESENT_GAIN * (latency_s - expected_s)
        pace.usual_s += USUAL_GAIN * (latency_s - pace.usual_s)
        pace.processing_s += PRESENT_GAIN * (processing_s - pace.processing_s)
        pace.noted_at = now

    def takes_at_least(self, service: ServiceName, path: PathId, latency_s: float, now: float) -> None:
        """Note that a copy that is not answered yet seems to take at least this latency."""
        pace = self._paces.get(_Key(service, path.interface, path.peer))
        if pace is not None and latency_s > pace.expected_s(now):
            pace.present_s = latency_s
            pace.noted_at = now

    def expected_s(self, service: ServiceName, path: PathId, now: float) -> float | None:
        """Return the seconds expected for the next answer over this pair; None when nothing is known about the service.

        A pair that has answered nothing yet is taken to be as fast as the fastest other one, plus the excess of its
        network's round trip.
        """
        pace = self._paces.get(_Key(service, path.interface, path.peer))
        if pace is not None:
            return pace.expected_s(now)
        others = (
            (other.usual_s, self._routes.best_over(key.interface, key.server))
            for key, other in self._paces.items()
            if key.service == service
        )
        mine = self._routes.rtt(path)
        guesses = [usual_s + max(0.0, mine - route.smoothed_rtt_s) for usual_s, route in others if route is not None]
        return min(guesses, default=None)

    def processing_s(self, service: ServiceName, path: PathId) -> float:
        """Return the seconds of that which the server needs; 0 while it has not answered."""
        pace = self._paces.get(_Key(service, path.interface, path.peer))
        return 0.0 if pace is None else pace.processing_s


WINDOW = 128
"""Copies remembered for each pair: enough for a quantile of 0.99, see `quantile_s`."""
MAX_SAMPLE_AGE_S = 120.0
"""After two minutes of driving the road has changed; older copies tell nothing."""
MAX_RECORDS = 4096
"""Pairs remembered, each for one service; beyond that the least recently used one goes."""
PRIOR_COPIES, PRIOR_MISSES = 10.0, 0.5
"""Pseudo-counts of a pair about which nothing is known: one copy in twenty misses. A pair that misses more often than
that loses its place to one never tried; a better one does not."""


class _Sample(NamedTuple):
    at: float
    latency_s: float
    """A lower bound if it was called off; infinite if it missed the deadline."""
    measured: bool


class PathRecords:
    """The last copies of each pair."""

    def __init__(self, stats: EngineStats) -> None:
        self._stats = stats
        self._samples: OrderedDict[_Key, deque[_Sample]] = OrderedDict()

    def note(self, request: Request, now: float) -> None:
        """Remember what became of a request's copies, once, when its deadline is over or every copy has ended."""
        for copy in request.started_together():
            if copy.state is not CopyState.REJECTED:
                self._add(request, copy, now)

    def _add(self, request: Request, copy: Copy, now: float) -> None:
        key = _Key(request.service, copy.path.interface, copy.path.peer)
        samples = self._samples.get(key)
        if samples is None:
            samples = self._samples[key] = deque(maxlen=WINDOW)
            if len(self._samples) > MAX_RECORDS:
                self._samples.popitem(last=False)
                self._stats.dropped["path_records_full"] += 1
        self._samples.move_to_end(key)
        known = copy.ended_at is not None and (copy.in_time or copy.state is CopyState.DEAD)
        latency_s = copy.ended_at - copy.sent_at if known and copy.ended_at is not None else math.inf
        samples.append(_Sample(now, latency_s, request.observed))

    def _recent(self, service: ServiceName, path: PathId, now: float) -> list[_Sample]:
        samples = self._samples.get(_Key(service, path.interface, path.peer), ())
        return [sample for sample in samples if sample.at >= now - MAX_SAMPLE_AGE_S]

    def miss_share(self, service: ServiceName, path: PathId, now: float) -> float:
        """Return the share of its copies that the pair is expected to answer late or never."""
        measured = [sample.latency_s for sample in self._recent(service, path, now) if sample.measured]
        return (measured.count(math.inf) + PRIOR_MISSES) / (len(measured) + PRIOR_COPIES)

    def quantile_s(self, service: ServiceName, path: PathId, quantile: float, now: float) -> float | None:
        """Return the latency (s) that the next copy keeps with at least this probability; None if too few are known.

        After n exchangeable latencies the next one is at most the k-th smallest with probability k / (n + 1), whatever
        their distribution: 0.95 needs nineteen. The result is infinite if the pair misses more often than that.
        """
        latencies = sorted(sample.latency_s for sample in self._recent(service, path, now))
        rank = math.ceil(quantile * (len(latencies) + 1))
        return latencies[rank - 1] if rank <= len(latencies) else None
