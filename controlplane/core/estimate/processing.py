"""Estimates what servers need to compute an answer, by server and service, from the reports of all robots."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from plr.controlplane.core.estimate.change_detection import ChangeWatch
from plr.controlplane.core.estimate.distribution import Distribution
from plr.controlplane.core.estimate.fading import FadedCount, FadedHistogram, forget_after_s
from plr.controlplane.core.estimate.staleness import HeardClock
from plr.controlplane.core.estimate.witnesses import COUNTS_ANYWAY, Witnesses
from plr.protos.base.histogram import Histogram

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName, ServiceName

MAX_PROCESSING = 8192
"""Processing histograms kept, one for each (server, service); the least recently reported one is evicted."""

MAX_PROCESSING_OF_SERVER = 1024
"""Limit per server, as many as it may offer at once: one that changes its offers evicts nobody else's."""

OTHERS_REQUESTS = 1.0
"""Worth of the other servers of a service, in requests to the server itself: machines are not alike."""

ENOUGH_REQUESTS = 50.0
"""Number of requests from which a server's own times stand alone."""

DOUBTED_REQUESTS = 0.25
"""Remaining worth of a server's times after another one has changed, if it was reported ..."""

HEARD_REQUESTS, LATELY_HALF_LIFE_S = 1.6, 2.0
"""... less often than this recently, fading with this half-life: by exploration alone, not by use."""


class ServerTimes(NamedTuple):
    """What a server is thought to need."""

    times: Distribution | None
    """None until somebody has asked any server."""
    requests: float
    """How many of its own requests they rest on."""


@dataclass(slots=True)
class _OfServer:
    """What a server needs for a service."""

    times: FadedHistogram
    lately: FadedCount
    witnesses: Witnesses
    watch: ChangeWatch = field(default_factory=ChangeWatch)
    changes: int = 0
    before: Distribution | None = None
    """What it needed before the last change."""

    def changed_with(self, robot: NodeName, processing: Histogram, now: float) -> Histogram | None:
        """Return what came since the server changed, if these samples of a robot, still to be added, show a change."""
        if not processing.total:
            return None
        since = self.times.held_against(processing, self.watch, now)
        if self.watch.accused:
            self.witnesses.accuses(robot)
        elif not self.watch.suspects:
            self.witnesses.acquit()
        if since is None:
            return None
        if not self.witnesses.agree(now):
            self.watch.doubted()
            return None
        self.watch.settled()
        self.witnesses.acquit()
        return since


@dataclass(slots=True)
class _OfService:
    """What is known of a service over all servers."""

    clock: HeardClock
    servers: dict[NodeName, FadedHistogram] = field(default_factory=dict)
    usual: Distribution | None = None
    """Distribution over all servers, each as one; None until it is computed."""


class ComputeTimes:
    """Fading processing times of every server, and what a service's servers usually need, for those not reported.

    A server that has changed is known only by what came since.
    """

    def __init__(self, half_life_s: float) -> None:
        self._half_life_s = half_life_s
        self._servers: OrderedDict[tuple[NodeName, ServiceName], _OfServer] = OrderedDict()
        self._services: dict[ServiceName, _OfService] = {}
        """Services of the servers kept."""
        self._kept: dict[NodeName, OrderedDict[ServiceName, None]] = {}
        """Services kept of each server, the least recently reported one first."""
        self.dropped = 0
        """Entries evicted because a table was full."""

    def merge(self, robot: NodeName, server: NodeName, service: ServiceName, processing: Histogram, now: float) -> bool:
        """Add what a server needed, as a robot reports; return True if that is not what it needed before."""
        samples = processing.total
        if not samples:
            return False
        of_service = self._services.get(service)
        if of_service is None:
            of_service = self._services[service] = _OfService(HeardClock(now))
        of_service.clock.hear(now)
        of_service.usual = None
        of_server = self._servers.get((server, service))
        if of_server is None:
            of_server = _OfServer(
                FadedHistogram(self._half_life_s, now, of_service.clock),
                FadedCount(LATELY_HALF_LIFE_S, now),
                Witnesses(self._half_life_s),
            )
            self._servers[server, service] = of_server
            of_service.servers[server] = of_server.times
        self._servers.move_to_end((server, service))
        kept = self._kept.get(server)
        if kept is None:
            kept = self._kept[server] = OrderedDict()
        kept[service] = None
        kept.move_to_end(service)
        if len(kept) > MAX_PROCESSING_OF_SERVER:
            self._drop(server, next(iter(kept)))
        elif len(self._servers) > MAX_PROCESSING:
            self._drop(*next(iter(self._servers)))
        # At most what a robot may count for: what it says of one moment must not pass for minutes.
        of_server.lately.add(min(samples, int(COUNTS_ANYWAY)), 0.0, now)
        # Not earlier: this may be the server's first report after a long time.
        self._forget_old(now)
        processing = of_server.witnesses.weigh(robot, processing, now)
        since = of_server.changed_with(robot, processing, now)
        if since is None:
            of_server.times.add(processing, now)
            return False
        of_server.changes += 1
        of_server.before = of_server.times.distribution()
        of_server.times = FadedHistogram(self._half_life_s, now, of_service.clock)
        of_server.times.add(since, now)
        of_service.servers[server] = of_server.times
        self._doubt_others(service, of_service, now)
        return True

    def _doubt_others(self, service: ServiceName, of_service: _OfService, now: float) -> None:
        """Discount servers hardly reported recently: load moved, and nobody knows from where or to where."""
        for name, times in of_service.servers.items():
            of_server = self._servers[name, service]
            if of_server.lately.weight(now) < HEARD_REQUESTS:
                of_server.changes += 1
                of_server.before = times.distribution()
                times.forget(DOUBTED_REQUESTS / max(times.weight(now), DOUBTED_REQUESTS))

    def _forget_old(self, now: float) -> None:
        """Forget servers not reported for long: new ones may keep coming, and all count for the usual times."""
        since = now - forget_after_s(self._half_life_s)
        while True:
            oldest, of_server = next(iter(self._servers.items()))
            if of_server.lately.at >= since:
                return
            self._forget(*oldest)

    def _drop(self, server: NodeName, service: ServiceName) -> None:
        self._forget(server, service)
        self.dropped += 1

    def _forget(self, server: NodeName, service: ServiceName) -> None:
        del self._servers[server, service]
        del self._kept[server][service]
        if not self._kept[server]:
            del self._kept[server]
        of_service = self._services[service]
        del of_service.servers[server]
        if not of_service.servers:
            del self._services[service]
        else:
            of_service.usual = None

    def changes(self, server: NodeName, service: ServiceName) -> tuple[int, Distribution | None]:
        """Return how often a server changed, and what it needed before the last change."""
        of_server = self._servers.get((server, service))
        return (of_server.changes, of_server.before) if of_server is not None else (0, None)

    def is_odd(self, server: NodeName, service: ServiceName) -> bool:
        """Return whether the server's last answers were odd, so that it may have changed."""
        of_server = self._servers.get((server, service))
        return of_server is not None and of_server.watch.suspects

    def requests(self, server: NodeName, service: ServiceName, now: float, *, sample: int) -> Histogram:
        """Return what the server itself needed; an unfaded sample counts `sample`."""
        of_server = self._servers.get((server, service))
        return of_server.times.scaled(now, sample) if of_server is not None else Histogram()

    def witnesses(self, server: NodeName, service: ServiceName) -> int:
        """Return how many robots reported what the server needs."""
        of_server = self._servers.get((server, service))
        return len(of_server.witnesses) if of_server is not None else 0

    def busiest_witness(self, server: NodeName, service: ServiceName, now: float) -> tuple[NodeName, float] | None:
        """Return the robot whose word counts for most, and its share of all; None without any."""
        of_server = self._servers.get((server, service))
        return of_server.witnesses.largest_share(now) if of_server is not None else None

    def times(self, server: NodeName, service: ServiceName, now: float) -> ServerTimes:
        """Return what the server is thought to need: the fewer its own times, the more the usual ones count."""
        of_server = self._servers.get((server, service))
        own = of_server.times.distribution() if of_server is not None else None
        requests = of_server.times.weight(now) if of_server is not None else 0.0
        if own is not None and requests >= ENOUGH_REQUESTS:
            return ServerTimes(own, requests)
        usual = self._usual(service, now)
        if own is None or usual is None:
            return ServerTimes(own or usual, requests)
        share = requests / (requests + OTHERS_REQUESTS)
        return ServerTimes(Distribution.mixed(own, share, usual), requests)

    def _usual(self, service: ServiceName, now: float) -> Distribution | None:
        """Return what an unknown server of the service needs: each server counts by how much is known of it."""
        of_service = self._services.get(service)
        if of_service is None:
            return None
        if of_service.usual is None:
            total = 0.0
            mixed: Distribution | None = None
            for times in of_service.servers.values():
                found = times.distribution()
                if found is None:
                    continue
                requests = times.weight(now)
                share = requests / (requests + OTHERS_REQUESTS)
                total += share
                mixed = Distribution.mixed(found, share / total, mixed) if mixed is not None else found
            of_service.usual = mixed
        return of_service.usual
