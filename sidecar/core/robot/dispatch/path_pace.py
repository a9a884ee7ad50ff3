"""Robot side: how long an answer takes at present over each pair of an interface and a server.

Two averages stand beside each other: the present one, which one answer moves half of the way, and the usual one. What
is known of the present soon tells nothing, so it fades into the usual. A copy that has been awaited for longer than
both says that its pair is slow now, long before it is answered.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from protos.model.ids import InterfaceName, NodeName, ServiceName
    from sidecar.core.base.values import PathId
    from sidecar.core.seam.stats import EngineStats
    from sidecar.core.transfer.routes import Routes

MAX_PACES = 4096
"""Pairs remembered, each for one service; then the one that was used longest ago goes."""
PRESENT_GAIN = 0.5
USUAL_GAIN = 1 / 16
FADE_S = 2.0
"""In which half of what sets the present apart from the usual is forgotten: so long lasts a bad spot on a road."""


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
    """The pace of each pair, by service: its requests are taken to be alike in size."""

    def __init__(self, routes: Routes, stats: EngineStats) -> None:
        self._routes = routes
        self._stats = stats
        self._paces: OrderedDict[_Key, _Pace] = OrderedDict()

    def answered(self, service: ServiceName, path: PathId, latency_s: float, processing_s: float, now: float) -> None:
        """A copy was answered `latency_s` after it was sent, `processing_s` of which was the server's."""
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
        """A copy that is not answered yet will not be before this latency, as it seems."""
        pace = self._paces.get(_Key(service, path.interface, path.peer))
        if pace is not None and latency_s > pace.expected_s(now):
            pace.present_s = latency_s
            pace.noted_at = now

    def expected_s(self, service: ServiceName, path: PathId, now: float) -> float | None:
        """What the next answer over this pair takes, in seconds; None when nothing is known of the service.

        A pair that has answered nothing yet is taken for as fast as the fastest other, as far as the networks' round
        trips are alike.
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
        """What the server needs of that, in seconds; 0 while it has not answered."""
        pace = self._paces.get(_Key(service, path.interface, path.peer))
        return 0.0 if pace is None else pace.processing_s
