"""What the robot measured since its last report to the control plane."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, NamedTuple

from protos.histogram import Histogram
from protos.model import MAX_JOINTS, JointReport, LatencyReport, OutcomeReport, PathReport, Report
from sidecar.core.path_id import PathState

if TYPE_CHECKING:
    from protos.model import Assignment, InterfaceName, NodeName, ServiceName
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
    """Latencies per (interface, server, service), round-trip times per path, outcomes per service and, joint ones, per
    pair of paths."""

    def __init__(self) -> None:
        self._clear()

    def _clear(self) -> None:
        self._latency: dict[_Pair, Histogram] = {}
        self._processing: dict[_Pair, Histogram] = {}
        self._paths: dict[PathId, _PathCounts] = {}
        self._outcomes: Counter[tuple[ServiceName, str]] = Counter()
        self._judged: Counter[_Pair] = Counter()
        self._missed: Counter[_Pair] = Counter()
        self._compared: Counter[tuple[ServiceName, Assignment, Assignment]] = Counter()
        self._both_missed: Counter[tuple[ServiceName, Assignment, Assignment]] = Counter()

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

    def judged(self, path: PathId, service: ServiceName, *, missed: bool) -> None:
        """Whether a copy missed the deadline is known."""
        pair = _Pair(path.interface, path.peer, service)
        self._judged[pair] += 1
        self._missed[pair] += missed

    def judged_together(
        self, service: ServiceName, first: Assignment, second: Assignment, *, both_missed: bool
    ) -> bool:
        """Whether two copies of a request both missed is known; False if the report is full of other pairs of paths."""
        key = (service, first, second)
        if key not in self._compared and len(self._compared) >= MAX_JOINTS:
            return False
        self._compared[key] += 1
        self._both_missed[key] += both_missed
        return True

    def take(self, routes: Routes, servers: list[NodeName]) -> Report:
        """Return everything since the last call, and the state of every path to these servers."""
        latencies = tuple(
            LatencyReport(
                *pair,
                self._latency.get(pair, Histogram()),
                self._processing.get(pair, Histogram()),
                self._judged[pair],
                self._missed[pair],
            )
            for pair in sorted(self._latency.keys() | self._judged.keys())
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
        joints = tuple(JointReport(*key, count, self._both_missed[key]) for key, count in self._compared.items())
        self._clear()
        return Report(latencies, paths, outcomes, joints)

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
