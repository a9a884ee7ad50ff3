"""Collects what the robot measured since its last report to the control plane."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from operator import itemgetter
from typing import TYPE_CHECKING

from plr.protos.base.histogram import Histogram
from plr.protos.base.size_class import size_class
from plr.protos.model.report import (
    MAX_JOINTS,
    MAX_LATENCIES,
    MAX_PATH_REPORTS,
    InterfaceJointReport,
    JointReport,
    LatencyReport,
    OutcomeReport,
    PathReport,
    Report,
)
from plr.sidecar.core.base.report_scope import ReportScope
from plr.sidecar.core.base.values import PathState

if TYPE_CHECKING:
    from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
    from plr.protos.model.mapping import Assignment
    from plr.sidecar.core.base.values import PathId
    from plr.sidecar.core.robot.request.request import Carried
    from plr.sidecar.core.seam.links import PathMeasured
    from plr.sidecar.core.transfer.routes import Routes

MAX_ANSWER_SIZES = 1024
"""Services whose latest answer size is kept: as many as a robot can carry."""


@dataclass(frozen=True, slots=True)
class InterfacePair:
    """Two interfaces and, if both copies go to one server, that server."""

    service: ServiceName
    first: InterfaceName
    second: InterfaceName
    """The interface whose name sorts after `first`."""
    server: NodeName | None


@dataclass(frozen=True, slots=True)
class PairOutcome:
    """What became of one request."""

    first_missed: bool
    second_missed: bool
    raced: bool
    """It was a full race. Otherwise a miss of one alone means nothing: the copy may have been called off."""


class JointCounts:
    """Counts of all requests over two interfaces since the last report."""

    __slots__ = ("both_missed", "only_first_missed", "only_second_missed", "races", "requests")

    def __init__(self) -> None:
        self.requests = self.both_missed = self.races = self.only_first_missed = self.only_second_missed = 0

    def add(self, outcome: PairOutcome) -> None:
        """Count a request."""
        self.requests += 1
        self.both_missed += outcome.first_missed and outcome.second_missed
        if outcome.raced:
            self.races += 1
            self.only_first_missed += outcome.first_missed and not outcome.second_missed
            self.only_second_missed += outcome.second_missed and not outcome.first_missed

    def report(self, pair: InterfacePair) -> InterfaceJointReport:
        """Return the report for the control plane."""
        return InterfaceJointReport(
            pair.service,
            pair.first,
            pair.second,
            pair.server,
            self.requests,
            self.both_missed,
            self.races,
            self.only_first_missed,
            self.only_second_missed,
        )


class _Counts:
    __slots__ = ("called_off", "missed", "network", "processing", "requests")

    def __init__(self) -> None:
        self.network = Histogram()
        self.called_off = Histogram()
        self.processing = Histogram()
        self.requests = 0
        self.missed = 0


class _PathCounts:
    __slots__ = ("lost", "rtt", "sent")

    def __init__(self) -> None:
        self.rtt = Histogram()
        self.sent = 0
        self.lost = 0


class Measurements:
    """Times and missed deadlines per (interface, server, service, size class), round-trip times per path, outcomes per
    service, and joint outcomes per pair of paths and per pair of interfaces."""

    def __init__(self, dropped: Counter[str]) -> None:
        self._dropped = dropped
        """Counters of what a report has no room for."""
        self._answer_bytes: dict[ServiceName, int] = {}
        self._next_path = 0
        """Index of the first path to report, where one report does not hold all."""
        self._changed: dict[tuple[InterfaceName, NodeName], None] = {}
        """Pairs whose paths went up or down since the last report."""
        self._missed = False
        """Whether a deadline was missed since the last whole report."""
        self._told: ReportScope | None = None
        """Scope of the early report asked for since the last one."""
        self._clear()

    def note_path_change(self, path: PathId) -> None:
        """Note that a path went up or down."""
        if len(self._changed) < MAX_PATH_REPORTS:
            self._changed[path.interface, path.peer] = None

    def take_urgency(self) -> ReportScope | None:
        """Return what to report before the next report is due, unless that was asked for since the last one."""
        wanted = ReportScope.ALL if self._missed else ReportScope.CHANGES if self._changed else None
        if wanted is None or self._told in (wanted, ReportScope.ALL):
            return None
        self._told = wanted
        return wanted

    def _clear(self) -> None:
        self._carried: dict[Carried, _Counts] = {}
        self._paths: dict[PathId, _PathCounts] = {}
        self._outcomes: Counter[tuple[ServiceName, str]] = Counter()
        self._compared: Counter[tuple[ServiceName, Assignment, Assignment]] = Counter()
        self._both_missed: Counter[tuple[ServiceName, Assignment, Assignment]] = Counter()
        self._interfaces: dict[InterfacePair, JointCounts] = {}

    def size_class(self, service: ServiceName, request_bytes: int) -> int:
        """Return the class of a request before its answer is known: the service's latest answer stands for it."""
        return size_class(request_bytes + self._answer_bytes.get(service, 0))

    def answered(self, carried: Carried, latency_s: float, processing_s: float, answer_bytes: int) -> None:
        """Record a copy that was answered `latency_s` after it was sent; the server took `processing_s` of that."""
        if carried.service in self._answer_bytes or len(self._answer_bytes) < MAX_ANSWER_SIZES:
            self._answer_bytes[carried.service] = answer_bytes
        counts = self._of(carried)
        if counts is not None:
            counts.network.record(latency_s - processing_s)
            counts.processing.record(processing_s)

    def called_off(self, carried: Carried, after_s: float) -> None:
        """Record a copy that was called off `after_s` after it was sent, before its server had it."""
        counts = self._of(carried)
        if counts is not None:
            counts.called_off.record(after_s)

    def lost(self, carried: Carried, *, delivered: bool) -> None:
        """Record a copy that was never answered: because of the server if it was `delivered`, else of the network."""
        counts = self._of(carried)
        if counts is not None:
            (counts.processing if delivered else counts.network).record_lost()

    def judged(self, carried: Carried, *, missed: bool) -> None:
        """Record whether a copy missed the deadline."""
        counts = self._of(carried)
        if counts is not None:
            counts.requests += 1
            counts.missed += missed

    def _of(self, carried: Carried) -> _Counts | None:
        counts = self._carried.get(carried)
        if counts is None:
            if len(self._carried) >= MAX_LATENCIES:
                self._dropped["latencies_full"] += 1
                return None
            counts = self._carried[carried] = _Counts()
        return counts

    def path(self, event: PathMeasured) -> None:
        """Record a link's measurement of a path."""
        counts = self._paths.setdefault(event.path, _PathCounts())
        for rtt in event.rtts_s:
            counts.rtt.record(rtt)
        counts.sent += event.sent
        counts.lost += event.lost

    def outcome(self, service: ServiceName, outcome: str) -> None:
        """Record a request's outcome; a missed deadline may mean that the mapping is wrong."""
        self._missed |= outcome == "deadline_missed"
        self._outcomes[service, outcome] += 1

    def judged_together(
        self, service: ServiceName, first: Assignment, second: Assignment, *, both_missed: bool
    ) -> None:
        """Record whether two copies of a request both missed."""
        key = (service, first, second)
        if key not in self._compared and len(self._compared) >= MAX_JOINTS:
            self._dropped["joint_outcomes_full"] += 1
            return
        self._compared[key] += 1
        self._both_missed[key] += both_missed

    def judged_interfaces(self, pair: InterfacePair, outcome: PairOutcome) -> None:
        """Record whether a request missed over each of two interfaces."""
        counts = self._interfaces.get(pair)
        if counts is None:
            if len(self._interfaces) >= MAX_JOINTS:
                self._dropped["joint_outcomes_full"] += 1
                return
            counts = self._interfaces[pair] = JointCounts()
        counts.add(outcome)

    def take(self, routes: Routes, servers: list[NodeName]) -> Report:
        """Return everything since the last call, and the state of as many paths to these servers as fit."""
        latencies = tuple(
            LatencyReport(*carried, of.network, of.called_off, of.processing, of.requests, of.missed)
            for carried, of in sorted(self._carried.items(), key=itemgetter(0))
        )
        known = [(interface, server) for server in servers for interface in routes.interfaces_to(server)]
        paths = tuple(self._path_report(interface, server, routes) for interface, server in self._in_turn(known))
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
        interface_joints = tuple(counts.report(pair) for pair, counts in self._interfaces.items())
        self._clear()
        self._changed.clear()
        self._missed, self._told = False, None
        return Report(latencies, paths, outcomes, joints, interface_joints)

    def take_changes(self, routes: Routes) -> Report:
        """Return the state of the paths that went up or down since the last call, or `take`, and their measurements."""
        there = [
            (interface, server) for interface, server in self._changed if interface in routes.interfaces_to(server)
        ]
        paths = tuple(self._path_report(interface, server, routes) for interface, server in there)
        for interface, server in there:
            for route in routes.all_to(server):
                if route.id.interface == interface:
                    self._paths.pop(route.id, None)
        self._changed.clear()
        self._told = ReportScope.ALL if self._told is ReportScope.ALL else None
        return Report(paths=paths, changes_only=True)

    def _in_turn(self, paths: list[tuple[InterfaceName, NodeName]]) -> list[tuple[InterfaceName, NodeName]]:
        """Return as many paths as one report holds, from where the last one ended, so that all have their turn."""
        left_out = len(paths) - MAX_PATH_REPORTS
        if left_out <= 0:
            return paths
        self._dropped["path_reports_full"] += left_out
        first = self._next_path % len(paths)
        self._next_path = first + MAX_PATH_REPORTS
        return (paths[first:] + paths[:first])[:MAX_PATH_REPORTS]

    def _path_report(self, interface: InterfaceName, server: NodeName, routes: Routes) -> PathReport:
        """Return one report for all paths between the two: the mapping knows interfaces and servers only."""
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
