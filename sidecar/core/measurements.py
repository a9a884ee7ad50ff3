"""What the robot measured since its last report to the control plane."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, NamedTuple

from protos.histogram import Histogram
from protos.model import LatencyReport, OutcomeReport, PathReport, Report
from sidecar.core.path_id import PathState

if TYPE_CHECKING:
    from protos.model import InterfaceName, NodeName, ServiceName
    from sidecar.core.link_events import PathMeasured
    from sidecar.core.path_id import PathId
    from sidecar.core.routes import Routes


class _Pair(NamedTuple):
    interface: InterfaceName
    server: NodeName
    service: ServiceName


class _PathCounts:
    __slots__ = ("lost", "rtt", "sent")

    def __init__(self) -> None:
        self.rtt = Histogram()
        self.sent = 0
        self.lost = 0


class Measurements:
    """Latencies per (interface, server, service), round-trip times per path, outcomes per service."""

    def __init__(self) -> None:
        self._clear()

    def _clear(self) -> None:
        self._latency: dict[_Pair, Histogram] = {}
        self._processing: dict[_Pair, Histogram] = {}
        self._paths: dict[PathId, _PathCounts] = {}
        self._outcomes: Counter[tuple[ServiceName, str]] = Counter()

    def answered(self, path: PathId, service: ServiceName, latency_s: float, processing_s: float) -> None:
        """One copy was answered `latency_s` after it was sent."""
        pair = _Pair(path.interface, path.peer, service)
        self._latency.setdefault(pair, Histogram()).record(latency_s)
        self._processing.setdefault(pair, Histogram()).record(processing_s)

    def lost(self, path: PathId, service: ServiceName) -> None:
        """One copy was never answered, or was called off after its deadline."""
        pair = _Pair(path.interface, path.peer, service)
        self._latency.setdefault(pair, Histogram()).record_lost()

    def path(self, event: PathMeasured) -> None:
        """A link measured a path."""
        counts = self._paths.setdefault(event.path, _PathCounts())
        for rtt in event.rtts_s:
            counts.rtt.record(rtt)
        counts.sent += event.sent
        counts.lost += event.lost

    def outcome(self, service: ServiceName, outcome: str) -> None:
        """A request ended."""
        self._outcomes[service, outcome] += 1

    def take(self, routes: Routes, servers: list[NodeName]) -> Report:
        """Return everything since the last call, and the state of every path to these servers."""
        latencies = tuple(
            LatencyReport(*pair, latency, self._processing.get(pair, Histogram()))
            for pair, latency in self._latency.items()
        )
        paths = tuple(
            self._path_report(interface, server, routes)
            for server in servers
            for interface in routes.interfaces_to(server)
        )
        services = {service for service, _ in self._outcomes}
        outcomes = tuple(
            OutcomeReport(
                service,
                ok=self._outcomes[service, "ok"],
                deadline_missed=self._outcomes[service, "deadline_missed"],
                failed=self._outcomes[service, "failed"] + self._outcomes[service, "rejected"],
            )
            for service in sorted(services)
        )
        self._clear()
        return Report(latencies, paths, outcomes)

    def _path_report(self, interface: InterfaceName, server: NodeName, routes: Routes) -> PathReport:
        """One report for all paths between the two: the mapping knows interfaces and servers only."""
        total = _PathCounts()
        up = False
        for route in routes.all_to(server):
            if route.id.interface != interface:
                continue
            up = up or route.state is PathState.UP
            counts = self._paths.get(route.id)
            if counts is not None:
                total.rtt.merge(counts.rtt)
                total.sent += counts.sent
                total.lost += counts.lost
        return PathReport(interface, server, up, total.rtt, total.sent, total.lost)
