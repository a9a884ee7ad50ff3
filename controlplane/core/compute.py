"""What servers need to compute an answer: by server and service, whoever asked."""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING, NamedTuple

from controlplane.core.distribution import Distribution
from controlplane.core.fading import FadedHistogram
from controlplane.core.silence import HeardClock
from protos.histogram import Histogram

if TYPE_CHECKING:
    from protos.model import NodeName, ServiceName

MAX_PROCESSING = 8192
"""Processing histograms kept, one for each (server, service); the least recently reported goes. So for services."""

OTHERS_REQUESTS = 2.0
"""What the other servers of a service are worth, in requests to a server itself: machines are not alike."""

ENOUGH_REQUESTS = 50.0
"""Requests from which on a server's own times stand alone."""


class _OfService(NamedTuple):
    """What is known of a service whichever server."""

    times: FadedHistogram
    clock: HeardClock


class ComputeTimes:
    """Processing times, fading, of every server and, for those not heard of, of all servers of a service together."""

    def __init__(self, half_life_s: float) -> None:
        self._half_life_s = half_life_s
        self._servers: OrderedDict[tuple[NodeName, ServiceName], FadedHistogram] = OrderedDict()
        self._services: OrderedDict[ServiceName, _OfService] = OrderedDict()
        self.dropped = 0
        """Entries evicted because a table was full."""

    def merge(self, server: NodeName, service: ServiceName, processing: Histogram, now: float) -> None:
        """Add what a server needed."""
        if not processing.total:
            return
        of_service = self._services.get(service)
        if of_service is None:
            clock = HeardClock(now)
            of_service = self._services[service] = _OfService(FadedHistogram(self._half_life_s, now), clock)
        self._services.move_to_end(service)
        if len(self._services) > MAX_PROCESSING:
            self._services.popitem(last=False)
            self.dropped += 1
        of_service.clock.hear(now)
        of_server = self._servers.get((server, service))
        if of_server is None:
            of_server = FadedHistogram(self._half_life_s, now, of_service.clock)
            self._servers[server, service] = of_server
        self._servers.move_to_end((server, service))
        if len(self._servers) > MAX_PROCESSING:
            self._servers.popitem(last=False)
            self.dropped += 1
        of_server.add(processing, now)
        of_service.times.add(processing, now)

    def requests(self, server: NodeName, service: ServiceName, now: float, *, sample: int) -> Histogram:
        """What the server itself needed; a sample that has not faded counts `sample`."""
        of_server = self._servers.get((server, service))
        return of_server.scaled(now, sample) if of_server is not None else Histogram()

    def times(self, server: NodeName, service: ServiceName, now: float) -> tuple[Distribution | None, float]:
        """What the server is thought to need, and how many of its own requests that rests on.

        None as long as nobody has asked any server.
        """
        of_server = self._servers.get((server, service))
        own = of_server.distribution() if of_server is not None else None
        requests = of_server.weight(now) if of_server is not None else 0.0
        if own is not None and requests >= ENOUGH_REQUESTS:
            return own, requests
        of_service = self._services.get(service)
        all_servers = of_service.times.distribution() if of_service is not None else None
        if own is None or all_servers is None:
            return own or all_servers, requests
        return Distribution.mixed(own, requests / (requests + OTHERS_REQUESTS), all_servers), requests
