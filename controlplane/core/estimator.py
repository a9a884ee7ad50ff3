"""Probability that a request misses its deadline, for every (robot, interface, server, service), and how much more
often than by chance two of a robot's paths miss together.

Requests that really ran are the best witness. For pairs that carried few or none, the round trips of the path and
the server's processing times (whoever measured them) stand in: see `Estimator.estimate`.
What is computed, and why: docs/theory.md.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from controlplane.core.fading import FadedCount, FadedHistogram, sum_exceeds
from controlplane.core.posterior import IGNORANCE, Estimate, FadedTrials
from protos.explanation import SAMPLE
from protos.histogram import Histogram

if TYPE_CHECKING:
    from collections.abc import Iterator

    from protos.model import Assignment, InterfaceName, NodeName, PathReport, Report, ServiceName

    Pair = tuple[InterfaceName, NodeName, ServiceName]
    PathKey = tuple[InterfaceName, NodeName]
    JointKey = tuple[ServiceName, Assignment, Assignment]

K = TypeVar("K")
V = TypeVar("V")

MODEL_REQUESTS = 5.0
"""What the estimate from round trips is worth in real requests, however many probes back it: probes are small, so it
errs by what the size of a request costs."""

MODEL_MAX_PROBES = 100.0
"""Probes beyond which more of them do not bring the estimate from round trips any nearer to 0 or 1."""

INDEPENDENCE_REQUESTS = 20.0
"""What the belief that paths fail independently is worth in requests sent over both."""

OVERHEAD_MIN_REQUESTS = 20.0
"""Requests a pair must have carried before it tells how much slower requests are than probes."""

MAX_PAIRS_PER_ROBOT = 1024
"""Latency histograms kept of one robot, the least recently reported goes: 4 interfaces, 16 servers, 16 services."""

MAX_PATHS_PER_ROBOT = 1024
"""Paths kept of one robot, the least recently reported goes."""

MAX_JOINTS_PER_ROBOT = 1024
"""Pairs of paths of one robot whose common misses are kept, the least recently reported goes."""

MAX_OUTCOMES_PER_ROBOT = 1024
"""Services kept of one robot, the least recently reported goes: as many as it can carry."""

MAX_HISTOGRAMS = 65_536
"""Histograms kept of all robots (3 kB each): beyond that, the robot that reported least recently is forgotten."""

MAX_PROCESSING = 8192
"""Processing histograms kept, one for each (server, service); the least recently reported goes."""


@dataclass(slots=True)
class PathState:
    """What is known of one path."""

    up: bool
    rtt: FadedHistogram
    datagrams: FadedCount
    last: PathReport

    def loss(self) -> float:
        """Share of what was sent that got lost, as datagrams or as probes, whichever is worse."""
        found = [ratio for ratio in (self.datagrams.ratio(), self.rtt.lost_share()) if not math.isnan(ratio)]
        return max(found, default=0.0)


@dataclass(frozen=True, slots=True)
class Evidence:
    """What an estimate rests on; histograms count `protos.explanation.SAMPLE` for a sample that has not faded."""

    requests: float
    probes: float
    rtt: Histogram
    latency: Histogram
    compute: Histogram


class _PairLatency:
    """Requests that ran on one pair: their latencies, and which of them missed the deadline."""

    __slots__ = ("histogram", "outcomes")

    def __init__(self, half_life_s: float, now: float) -> None:
        self.histogram = FadedHistogram(half_life_s, now)
        self.outcomes = FadedTrials(half_life_s, now)


class _Robot:
    """Tables fed by one robot."""

    __slots__ = ("joints", "latencies", "outcomes", "paths")

    def __init__(self) -> None:
        self.latencies: OrderedDict[Pair, _PairLatency] = OrderedDict()
        self.joints: OrderedDict[JointKey, FadedTrials] = OrderedDict()
        self.paths: OrderedDict[PathKey, PathState] = OrderedDict()
        self.outcomes: OrderedDict[ServiceName, FadedCount] = OrderedDict()

    def histograms(self) -> int:
        return len(self.latencies) + len(self.paths)


class Estimator:
    """Everything the robots measured, fading. Times are monotonic seconds."""

    def __init__(self, *, half_life_s: float) -> None:
        self._half_life_s = half_life_s
        self._robots: OrderedDict[NodeName, _Robot] = OrderedDict()
        self._processing: OrderedDict[tuple[NodeName, ServiceName], FadedHistogram] = OrderedDict()
        self._histograms = 0
        self.dropped = 0
        """Entries evicted because a table was full."""

    def merge(self, robot: NodeName, report: Report, now: float) -> bool:
        """Add a report; True if a path went up or down with it, or is reported for the first time."""
        tables = self._robots.get(robot)
        if tables is None:
            tables = self._robots[robot] = _Robot()
        self._robots.move_to_end(robot)
        self._histograms -= tables.histograms()
        for latency in report.latencies:
            pair = (latency.interface, latency.server, latency.service)
            if latency.latency.total or latency.requests:
                found = tables.latencies.get(pair) or _PairLatency(self._half_life_s, now)
                tables.latencies[pair] = found
                self._trim(tables.latencies, pair, MAX_PAIRS_PER_ROBOT)
                found.histogram.add(latency.latency, now)
                found.outcomes.add(latency.requests, latency.missed, now)
            if latency.processing.total:
                key = (latency.server, latency.service)
                processing = self._processing.get(key) or FadedHistogram(self._half_life_s, now)
                self._processing[key] = processing
                self._trim(self._processing, key, MAX_PROCESSING)
                processing.add(latency.processing, now)
        for joint in report.joints:
            joint_key = (joint.service, joint.first, joint.second)
            together = tables.joints.get(joint_key) or FadedTrials(self._half_life_s, now)
            tables.joints[joint_key] = together
            self._trim(tables.joints, joint_key, MAX_JOINTS_PER_ROBOT)
            together.add(joint.requests, joint.both_missed, now)
        changed = False
        for path in report.paths:
            changed |= self._merge_path(tables, path, now)
        for outcome in report.outcomes:
            bad = outcome.deadline_missed + outcome.failed
            count = tables.outcomes.get(outcome.service) or FadedCount(self._half_life_s, now)
            tables.outcomes[outcome.service] = count
            self._trim(tables.outcomes, outcome.service, MAX_OUTCOMES_PER_ROBOT)
            count.add(outcome.ok + bad, bad, now)
        self._histograms += tables.histograms()
        while self._histograms > MAX_HISTOGRAMS and len(self._robots) > 1:
            _, forgotten = self._robots.popitem(last=False)
            self._histograms -= forgotten.histograms()
            self.dropped += forgotten.histograms()
        return changed

    def _trim(self, table: OrderedDict[K, V], key: K, limit: int) -> None:
        """Mark `key` as used last, and evict the least recently used beyond `limit`."""
        table.move_to_end(key)
        if len(table) > limit:
            table.popitem(last=False)
            self.dropped += 1

    def _merge_path(self, tables: _Robot, path: PathReport, now: float) -> bool:
        key = (path.interface, path.server)
        known = tables.paths.get(key)
        if known is None:
            rtt = FadedHistogram(self._half_life_s, now)
            state = PathState(path.up, rtt, FadedCount(self._half_life_s, now), path)
        else:
            state = known
        tables.paths[key] = state
        self._trim(tables.paths, key, MAX_PATHS_PER_ROBOT)
        changed = known is None or known.up != path.up
        state.up = path.up
        state.last = path
        state.rtt.add(path.rtt, now)
        # What was sent before the last report may be found lost only now: no more is lost than is sent.
        state.datagrams.add(path.datagrams_sent, min(path.datagrams_lost, path.datagrams_sent), now)
        return changed

    def forget_paths(self, robot: NodeName) -> None:
        """The robot is gone or was started anew: whether its paths are up is not known any more."""
        tables = self._robots.get(robot)
        if tables is not None:
            self._histograms -= len(tables.paths)
            tables.paths.clear()

    def paths(self, robot: NodeName) -> Iterator[PathReport]:
        """The last report of each path of a robot."""
        tables = self._robots.get(robot)
        if tables is not None:
            yield from (state.last for state in tables.paths.values())

    def path_up(self, robot: NodeName, interface: InterfaceName, server: NodeName) -> bool | None:
        """Whether the path was up when last reported; None if it never was reported."""
        tables = self._robots.get(robot)
        state = tables.paths.get((interface, server)) if tables is not None else None
        return state.up if state is not None else None

    def observed_miss_ratio(self, robot: NodeName, service: ServiceName, now: float) -> float | None:
        """Share of the robot's recent requests that missed their deadline or failed; None without any."""
        tables = self._robots.get(robot)
        count = tables.outcomes.get(service) if tables is not None else None
        if count is None or count.weight(now) < IGNORANCE.misses:
            return None
        return count.ratio()

    def overhead(self, robot: NodeName, service: ServiceName, now: float) -> float:
        """How much slower, in seconds, this robot's requests of this service are than probes and processing.

        Probes are small: what the request's size costs shows only in pairs that carried some. Without this a pair
        never tried would look better than it is, and the plan would swing to it and back.
        """
        tables = self._robots.get(robot)
        if tables is None:
            return 0.0
        total = weights = 0.0
        for (interface, server, of_service), found in tables.latencies.items():
            if of_service != service:
                continue
            path = tables.paths.get((interface, server))
            latency = found.histogram
            weight = latency.weight(now)
            if path is None or weight < OVERHEAD_MIN_REQUESTS:
                continue
            excess = latency.median() - path.rtt.median()
            processing = self._processing.get((server, service))
            if processing is not None:
                excess -= processing.median()
            if math.isfinite(excess):
                total += weight * max(0.0, excess)
                weights += weight
        return total / weights if weights else 0.0

    def estimate(
        self,
        robot: NodeName,
        interface: InterfaceName,
        server: NodeName,
        service: ServiceName,
        deadline_s: float,
        now: float,
        *,
        overhead_s: float = 0.0,
    ) -> Estimate:
        """epsilon_ij = P(L_ij > deadline), as the posterior of the requests that ran on this pair.

        The prior comes from round trips and processing times, and is worth `MODEL_REQUESTS`. Without those it is
        `IGNORANCE`.
        """
        tables = self._robots.get(robot)
        if tables is None:
            return IGNORANCE
        prior = IGNORANCE
        path = tables.paths.get((interface, server))
        if path is not None:
            model = self._model(path, self._processing.get((server, service)), deadline_s - overhead_s)
            if math.isfinite(model):
                probes = min(path.rtt.weight(now), MODEL_MAX_PROBES)
                mean = (probes * model + IGNORANCE.misses) / (probes + IGNORANCE.weight)
                prior = Estimate.of(mean, min(MODEL_REQUESTS, probes + IGNORANCE.weight))
        latency = tables.latencies.get((interface, server, service))
        return latency.outcomes.posterior(prior, now) if latency is not None else prior

    def evidence(self, robot: NodeName, path: Assignment, service: ServiceName, now: float) -> Evidence:
        """What was measured on this pair, for the operator."""
        tables = self._robots.get(robot)
        state = tables.paths.get((path.interface, path.server)) if tables is not None else None
        pair = tables.latencies.get((path.interface, path.server, service)) if tables is not None else None
        processing = self._processing.get((path.server, service))

        def told(histogram: FadedHistogram | None) -> Histogram:
            return histogram.scaled(now, SAMPLE) if histogram is not None else Histogram()

        return Evidence(
            requests=pair.outcomes.counts(now)[0] if pair is not None else 0.0,
            probes=state.rtt.weight(now) if state is not None else 0.0,
            rtt=told(state.rtt if state is not None else None),
            latency=told(pair.histogram if pair is not None else None),
            compute=told(processing),
        )

    def raced_counts(
        self, robot: NodeName, service: ServiceName, now: float
    ) -> Iterator[tuple[Assignment, Assignment, float, float]]:
        """The pairs of paths that carried copies of the same requests: how many, and how many missed on both."""
        tables = self._robots.get(robot)
        if tables is not None:
            for (of, first, second), together in tables.joints.items():
                if of == service:
                    yield (first, second, *together.counts(now))

    def raced_together(self, robot: NodeName, service: ServiceName) -> Iterator[tuple[Assignment, Assignment]]:
        """The pairs of paths that carried copies of the same requests."""
        tables = self._robots.get(robot)
        if tables is not None:
            yield from ((first, second) for of, first, second in tables.joints if of == service)

    def both_miss(
        self, robot: NodeName, service: ServiceName, first: Assignment, second: Assignment, product: float, now: float
    ) -> Estimate:
        """P(requests over both paths miss on both), where `product` is that probability if they fail independently.

        `first` comes before `second` in the order of their names. Without common requests it is the product.
        """
        prior = Estimate.of(product, INDEPENDENCE_REQUESTS)
        tables = self._robots.get(robot)
        together = tables.joints.get((service, first, second)) if tables is not None else None
        return together.posterior(prior, now) if together is not None else prior

    @staticmethod
    def _model(path: PathState, processing: FadedHistogram | None, deadline_s: float) -> float:
        """P(round trip + processing > deadline); what is lost costs one more round trip to be noticed and sent."""
        loss = path.loss()
        prompt = sum_exceeds(path.rtt, processing, deadline_s)
        if not loss or math.isnan(prompt):
            return prompt
        return (1.0 - loss) * prompt + loss * sum_exceeds(path.rtt, processing, deadline_s, times=2.0)
