"""Estimates how likely a request misses its deadline, for every (robot, interface, server, service), and how much more
often than by chance two of a robot's paths miss together.

Requests of the service that really ran are the best witness. For pairs that carried few or none, what the network takes
(`network`) and what the server needs (`processing`) are combined. Method and reasons: docs/develop/theory.md.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from plr.controlplane.core.estimate.composed import Asked, from_parts, parts_of, slower_than
from plr.controlplane.core.estimate.fading import FadedCount, FadedShares, forget_after_s, forget_before
from plr.controlplane.core.estimate.interface_trouble import InterfaceTrouble
from plr.controlplane.core.estimate.late_fate import LateFate
from plr.controlplane.core.estimate.network import ReportedPath, RobotNetwork
from plr.controlplane.core.estimate.penalties import ReportedPenalties
from plr.controlplane.core.estimate.posterior import IGNORANCE, Estimate, FadedTrials
from plr.controlplane.core.estimate.processing import ComputeTimes, ServerTimes
from plr.controlplane.core.estimate.shared_fate import SharedFate
from plr.controlplane.core.estimate.staleness import HeardClock
from plr.protos.base.histogram import Histogram
from plr.protos.base.size_class import SIZE_CLASSES
from plr.protos.model.explanation import SAMPLE

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    import numpy as np
    from numpy.typing import NDArray

    from plr.controlplane.core.estimate.composed import Parts
    from plr.controlplane.core.estimate.network import PathRecord
    from plr.controlplane.core.estimate.shared_fate import CommonMisses
    from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
    from plr.protos.model.mapping import Assignment
    from plr.protos.model.report import JointReport, LatencyReport, PathReport, PenaltyReport, Report

    Pair = tuple[InterfaceName, NodeName, ServiceName]
    JointKey = tuple[ServiceName, Assignment, Assignment]
    FateKey = tuple[ServiceName, InterfaceName, InterfaceName, NodeName | None]

K = TypeVar("K")
V = TypeVar("V")

CHANGE_MATTERS = 0.1
"""A pair's outcomes are those of another server if, by its parts, the server's change moves its miss probability this
far."""

CHANGE_KEEPS_REQUESTS = 1.0
"""How many of these outcomes still count then."""

USUAL_SIZE_SHARE = 0.1
"""Share of a service's requests below which a size class is left out of its estimate."""

INDEPENDENCE_REQUESTS = 20.0
"""Worth of the belief that paths fail independently, in requests sent over both."""

MAX_PAIRS_PER_ROBOT = 1024
"""Pairs of one robot whose missed deadlines are kept by service: 4 interfaces, 16 servers, 16 services. The least
recently reported one is evicted."""

MAX_JOINTS_PER_ROBOT = 1024
"""Pairs of paths of one robot whose common misses are kept; the least recently reported one is evicted."""

MAX_FATES_PER_ROBOT = 1024
"""Pairs of interfaces of one robot whose common misses are kept, by service and, for copies to one server, by server;
the least recently reported one is evicted."""

MAX_OUTCOMES_PER_ROBOT = 1024
"""Services kept of one robot, as many as it can carry; the least recently reported one is evicted."""

MAX_HISTOGRAMS = 131_072
"""Histograms kept of all robots: 4,096 robots with 3 interfaces and 5 servers need 122,880. Beyond that, robots that
have not reported for `LIVE_S` are forgotten, the longest silent first. If there are none, robots that have their equal
share get no new ones. So no robot that reports loses what another one brings."""

MAX_ESTIMATED_ROBOTS = 8192
"""Robots kept, including some that left: twice as many as may be registered."""

LIVE_S = 60.0
"""A robot that reported within this time is not forgotten for another one: several of the longest intervals."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """What an estimate rests on; in the histograms, an unfaded sample counts `plr.protos.model.explanation.SAMPLE`."""

    requests: float
    probes: float
    rtt: Histogram
    network: Histogram
    compute: Histogram
    witnesses: int
    """Number of robots that reported what the server needs."""
    busiest: tuple[NodeName, float] | None
    """The robot whose word counts for most, and its share."""


class _Service:
    """Sizes of one robot's requests of a service, and for how long these have been reported."""

    __slots__ = ("clock", "sizes")

    def __init__(self, half_life_s: float, now: float) -> None:
        self.sizes = FadedShares(SIZE_CLASSES, half_life_s, now)
        self.clock = HeardClock(now)


class _Outcomes:
    """What became of one robot's requests of a service: recently, and in total since this is kept."""

    __slots__ = ("faded", "missed", "requests")

    def __init__(self, half_life_s: float, now: float) -> None:
        self.faded = FadedCount(half_life_s, now)
        self.requests = 0
        self.missed = 0


class _Pair:
    """Requests of a service over a path, and how often its server had changed when last checked."""

    __slots__ = ("changes", "trials")

    def __init__(self, trials: FadedTrials, changes: int) -> None:
        self.trials = trials
        self.changes = changes


class _Robot:
    """Tables fed by one robot."""

    __slots__ = (
        *(
            "fates",
            "heard_at",
            "joints",
            "late",
            "network",
            "outcomes",
            "penalties",
            "services",
            "trials",
            "troubles",
            "troubles_at",
        ),
    )

    def __init__(self, half_life_s: float) -> None:
        self.heard_at = 0.0
        self.network = RobotNetwork(half_life_s)
        self.trials: OrderedDict[Pair, _Pair] = OrderedDict()
        self.joints: OrderedDict[JointKey, FadedTrials] = OrderedDict()
        self.fates: OrderedDict[FateKey, SharedFate] = OrderedDict()
        self.services: OrderedDict[ServiceName, _Service] = OrderedDict()
        self.outcomes: OrderedDict[ServiceName, _Outcomes] = OrderedDict()
        self.late: OrderedDict[ServiceName, LateFate] = OrderedDict()
        self.penalties = ReportedPenalties()
        self.troubles: dict[tuple[ServiceName, float, InterfaceName], InterfaceTrouble] = {}
        """Computed, by service, deadline and interface ..."""
        self.troubles_at = (0, 0.0)
        """... from this many reports of all robots, at this time."""


def _usual_sizes(tables: _Robot, service: ServiceName) -> tuple[tuple[int, float], ...]:
    """Return (size class, share) of the service's requests; the smallest class until there are any."""
    of_service = tables.services.get(service)
    return tuple(of_service.sizes.shares(USUAL_SIZE_SHARE)) if of_service is not None else ((0, 1.0),)


class Estimator:
    """Everything the robots measured, fading. Times are monotonic seconds."""

    def __init__(self, *, half_life_s: float) -> None:
        self._half_life_s = half_life_s
        self._robots: OrderedDict[NodeName, _Robot] = OrderedDict()
        self._compute = ComputeTimes(half_life_s)
        self._histograms = 0
        self._dropped = 0
        self._reports = 0
        self._times: dict[tuple[NodeName, ServiceName], ServerTimes] = {}
        """Computed ..."""
        self._parts: dict[tuple[ServiceName, Asked], Parts] = {}
        """... like what is known of each path of this robot ..."""
        self._worked_out_of: _Robot | None = None
        self._worked_out_at = (0, 0.0)
        """... from this many reports, at this time."""

    @property
    def dropped(self) -> int:
        """Entries evicted because a table was full."""
        return self._dropped + self._compute.dropped

    def merge(self, robot: NodeName, report: Report, now: float) -> bool:
        """Add a report. Return True if a path went up or down or is new, if a server needs other times than before, or
        if the set of penalised servers changed."""
        self._reports += not report.continues
        tables = self._robots.get(robot)
        if tables is None:
            tables = self._robots[robot] = _Robot(self._half_life_s)
        self._robots.move_to_end(robot)
        tables.heard_at = now
        network = tables.network
        self._forget_silent(robot, now)
        network.most = MAX_HISTOGRAMS // len(self._robots) if self._histograms >= MAX_HISTOGRAMS else MAX_HISTOGRAMS
        self._histograms -= len(network)
        dropped_before = network.dropped
        changed = not report.continues and tables.penalties.replace(report.penalties, now)
        for latency in report.latencies:
            changed |= self._merge_latency(robot, tables, latency, now)
        for joint in report.joints:
            self._merge_joint(tables, joint, now)
        for fate in report.interface_joints:
            fate_key = (fate.service, fate.first, fate.second, fate.server)
            shared = tables.fates.get(fate_key) or SharedFate(now)
            self._keep(tables.fates, fate_key, shared, MAX_FATES_PER_ROBOT)
            shared.add(fate, now)
        for path in report.paths:
            changed |= network.merge_path(path, now)
        for outcome in report.outcomes:
            bad = outcome.deadline_missed + outcome.failed
            count = tables.outcomes.get(outcome.service) or _Outcomes(self._half_life_s, now)
            self._keep(tables.outcomes, outcome.service, count, MAX_OUTCOMES_PER_ROBOT)
            count.faded.add(outcome.ok + bad, bad, now)
            count.requests += outcome.ok + bad
            count.missed += bad
            self._late_fate(tables, outcome.service, now).add_requests(outcome.ok + bad, bad, now)
        self._forget_old(tables, now)
        self._dropped += network.dropped - dropped_before
        self._histograms += len(network)
        return changed

    def _forget_old(self, tables: _Robot, now: float) -> None:
        """Forget robots, and paths of this robot, that nobody has reported on for long: most never come back."""
        since = now - forget_after_s(self._half_life_s)
        tables.network.forget_before(since)
        forget_before(tables.trials, since, lambda pair: pair.trials.at)
        forget_before(tables.joints, since, lambda together: together.at)
        forget_before(tables.fates, since, lambda fate: fate.at)
        forget_before(tables.services, since, lambda of_service: of_service.sizes.at)
        forget_before(tables.outcomes, since, lambda count: count.faded.at)
        forget_before(tables.late, since, lambda late: late.at)
        while (oldest := next(iter(self._robots.values()))).heard_at < since:
            self._robots.popitem(last=False)
            self._histograms -= len(oldest.network)

    def _forget_silent(self, robot: NodeName, now: float) -> None:
        """Make room for this robot's report by forgetting robots that have been silent for long, if any."""
        while self._histograms >= MAX_HISTOGRAMS or len(self._robots) > MAX_ESTIMATED_ROBOTS:
            name, silent = next(iter(self._robots.items()))
            if name == robot or now - silent.heard_at < LIVE_S:
                return
            del self._robots[name]
            self._histograms -= len(silent.network)
            self._dropped += len(silent.network)

    def _merge_latency(self, robot: NodeName, tables: _Robot, latency: LatencyReport, now: float) -> bool:
        tables.network.merge_requests(latency, now)
        changed = self._compute.merge(robot, latency.server, latency.service, latency.processing, now)
        if latency.requests:
            of_service = tables.services.get(latency.service) or _Service(self._half_life_s, now)
            self._keep(tables.services, latency.service, of_service, MAX_OUTCOMES_PER_ROBOT)
            of_service.sizes.add(latency.size_class, latency.requests, now)
            of_service.clock.hear(now)
            self._late_fate(tables, latency.service, now).add_first(latency.requests, latency.missed, now)
            pair = (latency.interface, latency.server, latency.service)
            found = tables.trials.get(pair)
            if found is None:
                changes, _ = self._compute.changes(latency.server, latency.service)
                found = _Pair(FadedTrials(self._half_life_s, now, of_service.clock), changes)
            self._keep(tables.trials, pair, found, MAX_PAIRS_PER_ROBOT)
            found.trials.add(latency.requests, latency.missed, now)
        return changed

    def _late_fate(self, tables: _Robot, service: ServiceName, now: float) -> LateFate:
        found = tables.late.get(service) or LateFate(now)
        self._keep(tables.late, service, found, MAX_OUTCOMES_PER_ROBOT)
        return found

    def _merge_joint(self, tables: _Robot, joint: JointReport, now: float) -> None:
        key = (joint.service, joint.first, joint.second)
        of_service = tables.services.get(joint.service)
        clock = of_service.clock if of_service is not None else None
        together = tables.joints.get(key) or FadedTrials(self._half_life_s, now, clock)
        self._keep(tables.joints, key, together, MAX_JOINTS_PER_ROBOT)
        together.add(joint.requests, joint.both_missed, now)

    def _keep(self, table: OrderedDict[K, V], key: K, value: V, limit: int) -> None:
        """Insert the value as most recently used, and evict the least recently used one beyond `limit`."""
        table[key] = value
        table.move_to_end(key)
        if len(table) > limit:
            table.popitem(last=False)
            self._dropped += 1

    def forget_paths(self, robot: NodeName) -> None:
        """Forget whether the robot's paths are up: it is gone or has restarted."""
        tables = self._robots.get(robot)
        if tables is not None:
            self._histograms -= len(tables.network)
            tables.network.forget_paths()
            # It may send copies in another way now.
            tables.late.clear()
            self._worked_out_of = None
            self._histograms += len(tables.network)

    def paths(self, robot: NodeName) -> Iterator[PathReport]:
        """Yield the last report of each path of a robot."""
        tables = self._robots.get(robot)
        if tables is not None:
            yield from (state.last for state in tables.network.paths.values())

    def path_states(self, robot: NodeName) -> Mapping[tuple[InterfaceName, NodeName], PathRecord]:
        """Return what is known of each path of a robot: the table itself, which `forget_paths` leaves to its holder."""
        tables = self._robots.get(robot)
        return tables.network.paths if tables is not None else {}

    def path_changes(self, robot: NodeName) -> Mapping[InterfaceName, int]:
        """Return how often paths over each interface of a robot went up or down, as far as it reported that."""
        tables = self._robots.get(robot)
        return tables.network.changes if tables is not None else {}

    def path_views(self, robot: NodeName) -> Iterator[ReportedPath]:
        """Yield each path of a robot as last reported, with its remembered round trips."""
        tables = self._robots.get(robot)
        if tables is not None:
            for key, state in tables.network.paths.items():
                yield ReportedPath(*key, state.up, state.rtt.median_once(), tables.network.leads_there(key))

    def path_up(self, robot: NodeName, interface: InterfaceName, server: NodeName) -> bool | None:
        """Return whether the path was up when last reported; None if it was never reported."""
        tables = self._robots.get(robot)
        state = tables.network.paths.get((interface, server)) if tables is not None else None
        return state.up if state is not None else None

    def penalties(self, robot: NodeName, now: float) -> Mapping[NodeName, PenaltyReport]:
        """Return the servers that the robot asks only as a last resort, as their answers could not be delivered."""
        tables = self._robots.get(robot)
        return tables.penalties.in_force(now) if tables is not None else {}

    def observed_miss_ratio(self, robot: NodeName, service: ServiceName, now: float) -> float | None:
        """Return the share of the robot's recent requests that missed their deadline or failed; None without any."""
        tables = self._robots.get(robot)
        count = tables.outcomes.get(service) if tables is not None else None
        if count is None or count.faded.weight(now) < IGNORANCE.misses:
            return None
        return count.faded.ratio()

    def counted(self, robot: NodeName, service: ServiceName) -> tuple[int, int]:
        """Return how many of the robot's requests ended, and how many of these missed their deadline or failed. Both
        restart at 0 after the robot has not reported for long."""
        tables = self._robots.get(robot)
        count = tables.outcomes.get(service) if tables is not None else None
        return (count.requests, count.missed) if count is not None else (0, 0)

    def estimate(
        self,
        robot: NodeName,
        interface: InterfaceName,
        server: NodeName,
        service: ServiceName,
        deadline_s: float,
        now: float,
    ) -> Estimate:
        """Return epsilon_ij = P(L_ij > deadline), as the posterior of the requests that ran on this pair.

        The prior combines network and processing times, or is `IGNORANCE` if nothing is known of the network. It is
        moved by the trouble that requests to other servers met over the interface.
        """
        tables = self._robots.get(robot)
        if tables is None:
            return IGNORANCE
        pair = tables.trials.get((interface, server, service))
        carried = pair.trials.counts(now)[0] if pair is not None else 0.0
        self._begin(tables, now)
        processing = self._times_of(server, service, now)
        asked = Asked(interface, server, _usual_sizes(tables, service), deadline_s)
        prior = from_parts(self._parts_of(tables, service, asked, now), carried, processing.requests)
        trouble = self._trouble(tables, service, deadline_s, interface, now)
        if pair is None:
            return trouble.moved(prior, interface, server)
        changes, before = self._compute.changes(server, service)
        if pair.changes != changes:
            pair.changes = changes
            parts = parts_of(asked, tables.network, ServerTimes(before, processing.requests), now)
            if abs(prior.mean - from_parts(parts, carried, processing.requests).mean) > CHANGE_MATTERS:
                pair.trials.forget(CHANGE_KEEPS_REQUESTS / max(carried, CHANGE_KEEPS_REQUESTS))
        return pair.trials.posterior(trouble.moved(prior, interface, server), now)

    def carried(self, robot: NodeName, pair: Pair, now: float) -> float:
        """Return how many requests of the service were measured over this pair, as far as they still count."""
        tables = self._robots.get(robot)
        found = tables.trials.get(pair) if tables is not None else None
        return found.trials.counts(now)[0] if found is not None else 0.0

    def late_fate(self, robot: NodeName, service: ServiceName, now: float) -> tuple[float, float]:
        """Return how many first copies and how many requests missed, see `LateFate.counts`."""
        tables = self._robots.get(robot)
        found = tables.late.get(service) if tables is not None else None
        return found.counts(now) if found is not None else (0.0, 0.0)

    def slower_than(
        self, robot: NodeName, pair: Pair, seconds: NDArray[np.float64], now: float
    ) -> NDArray[np.float64] | None:
        """Return how likely an answer over this pair takes longer than each time, by network and processing times.

        Return None if nothing is known of the network.
        """
        tables = self._robots.get(robot)
        if tables is None:
            return None
        interface, server, service = pair
        asked = Asked(interface, server, _usual_sizes(tables, service), 0.0)
        return slower_than(asked, tables.network, self._compute.times(server, service, now), seconds, now)

    def _begin(self, tables: _Robot, now: float) -> None:
        """Discard what was computed from other reports, or for another time or robot."""
        at = (self._reports, now)
        if self._worked_out_at != at:
            self._worked_out_at = at
            self._times.clear()
            self._parts.clear()
        elif self._worked_out_of is not tables:
            self._parts.clear()
        self._worked_out_of = tables
        if tables.troubles_at != at:
            tables.troubles.clear()
            tables.troubles_at = at

    def _times_of(self, server: NodeName, service: ServiceName, now: float) -> ServerTimes:
        key = (server, service)
        times = self._times.get(key)
        if times is None:
            times = self._times[key] = self._compute.times(server, service, now)
        return times

    def _parts_of(self, tables: _Robot, service: ServiceName, asked: Asked, now: float) -> Parts:
        key = (service, asked)
        parts = self._parts.get(key)
        if parts is None:
            times = self._times_of(asked.server, service, now)
            parts = self._parts[key] = parts_of(asked, tables.network, times, now)
        return parts

    def _trouble(
        self, tables: _Robot, service: ServiceName, deadline_s: float, wanted: InterfaceName, now: float
    ) -> InterfaceTrouble:
        """Return what the robot's requests of the service met over this interface beyond what their parts explain."""
        trouble = tables.troubles.get((service, deadline_s, wanted))
        if trouble is None:
            trouble = tables.troubles[service, deadline_s, wanted] = InterfaceTrouble()
            sizes = _usual_sizes(tables, service)
            for (interface, server, of), pair in tables.trials.items():
                if interface != wanted:
                    continue
                # Outcomes of a server that changed, or may be changing now, say nothing of the interface.
                if of != service or pair.changes != self._compute.changes(server, service)[0]:
                    continue
                if self._compute.is_odd(server, service):
                    continue
                parts = self._parts_of(tables, service, Asked(interface, server, sizes, deadline_s), now)
                expected = from_parts(parts, 0.0, self._times_of(server, service, now).requests)
                requests, _ = pair.trials.counts(now)
                trouble.note(interface, server, requests, expected, pair.trials.posterior(expected, now))
        return trouble

    def evidence(
        self, robot: NodeName, path: Assignment, service: ServiceName, now: float, *, servers_now: float | None = None
    ) -> Evidence:
        """Return what was measured on this pair, for the operator.

        For a robot that is gone, `now` is when it left; others report on its servers since, until `servers_now`.
        """
        servers_now = now if servers_now is None else servers_now
        tables = self._robots.get(robot) or _Robot(self._half_life_s)
        state = tables.network.paths.get((path.interface, path.server))
        pair = tables.trials.get((path.interface, path.server, service))
        network = Histogram()
        for size_class, _ in _usual_sizes(tables, service):
            network.merge(tables.network.requests(path.interface, path.server, size_class, now, sample=SAMPLE))
        return Evidence(
            requests=pair.trials.counts(now)[0] if pair is not None else 0.0,
            probes=state.rtt.weight(now) if state is not None else 0.0,
            rtt=state.rtt.scaled(now, SAMPLE) if state is not None else Histogram(),
            network=network,
            compute=self._compute.requests(path.server, service, servers_now, sample=SAMPLE),
            witnesses=self._compute.witnesses(path.server, service),
            busiest=self._compute.busiest_witness(path.server, service, servers_now),
        )

    def common_misses(
        self, robot: NodeName, service: ServiceName, now: float
    ) -> Iterator[tuple[InterfaceName, InterfaceName, NodeName | None, CommonMisses]]:
        """Yield the pairs of interfaces that carried copies of the same requests: to that server, or if None to two."""
        tables = self._robots.get(robot)
        for (of, first, second, server), fate in tables.fates.items() if tables is not None else ():
            if of == service and (found := fate.common_misses(now)) is not None:
                yield first, second, server, found

    def raced_together(self, robot: NodeName, service: ServiceName) -> Iterator[tuple[Assignment, Assignment]]:
        """Yield the pairs of paths that carried copies of the same requests."""
        tables = self._robots.get(robot)
        if tables is not None:
            yield from ((first, second) for of, first, second in tables.joints if of == service)

    def both_miss(
        self, robot: NodeName, service: ServiceName, first: Assignment, second: Assignment, product: float, now: float
    ) -> Estimate:
        """Return P(requests over both paths miss on both); `product` is that probability if they fail independently.

        `first` comes before `second` in the order of their names. Without common requests the result is the product.
        """
        prior = Estimate.of(product, INDEPENDENCE_REQUESTS)
        tables = self._robots.get(robot)
        together = tables.joints.get((service, first, second)) if tables is not None else None
        return together.posterior(prior, now) if together is not None else prior
