"""Robot side: how the copies sent over each pair of an interface and a server fared lately, to choose between pairs.

What was called off is known to have taken longer than until then. For a quantile below that moment this is as good as
the latency itself, and no hedge is sent before the quantile it waits for: so the delay of hedges stays true although
most of what is slow is called off. Which pair misses least is asked of measured requests only (`Request.observed`).
"""

from __future__ import annotations

import math
from collections import OrderedDict, deque
from typing import TYPE_CHECKING, NamedTuple

from sidecar.core.robot.request.request import CopyState

if TYPE_CHECKING:
    from protos.model.ids import InterfaceName, NodeName, ServiceName
    from sidecar.core.base.values import PathId
    from sidecar.core.robot.request.request import Copy, Request
    from sidecar.core.seam.stats import EngineStats

WINDOW = 128
"""Copies remembered for each pair: enough for a quantile of 0.99, see `quantile_s`."""
MAX_AGE_S = 120.0
"""A road is another one after so long: older copies tell nothing."""
MAX_RECORDS = 4096
"""Pairs remembered, each for one service; then the one that was used longest ago goes."""
PRIOR_COPIES, PRIOR_MISSES = 10.0, 0.5
"""What is believed of a pair before anything is known: one in twenty misses. A pair that misses more often than that
loses its place to one never tried, a better one does not."""


class _Sample(NamedTuple):
    at: float
    latency_s: float
    """At least, if it was called off; infinite if it missed the deadline."""
    measured: bool


class _Key(NamedTuple):
    service: ServiceName
    interface: InterfaceName
    server: NodeName


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
        return [sample for sample in samples if sample.at >= now - MAX_AGE_S]

    def miss_share(self, service: ServiceName, path: PathId, now: float) -> float:
        """What share of its copies the pair is expected to bring back late or never."""
        measured = [sample.latency_s for sample in self._recent(service, path, now) if sample.measured]
        return (measured.count(math.inf) + PRIOR_MISSES) / (len(measured) + PRIOR_COPIES)

    def quantile_s(self, service: ServiceName, path: PathId, quantile: float, now: float) -> float | None:
        """Seconds within which the next copy is answered with at least this probability; None if too few are known.

        Among n latencies alike the next one is at most the k-th smallest with probability k / (n + 1), whatever their
        distribution: for 0.95 nineteen are needed. Infinite where the pair misses more often than that.
        """
        latencies = sorted(sample.latency_s for sample in self._recent(service, path, now))
        rank = math.ceil(quantile * (len(latencies) + 1))
        return latencies[rank - 1] if rank <= len(latencies) else None
