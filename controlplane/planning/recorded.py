"""Predicts from what a running control plane measured of one robot's service: the answer of `plr explain --json`."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import numpy as np
from google.protobuf import json_format

from plr.controlplane.core.estimate.distribution import Distribution
from plr.controlplane.core.estimate.posterior import IGNORANCE
from plr.controlplane.core.problem.objectives import joint_miss, objective_costs
from plr.controlplane.core.problem.problem import Block, BlockKey, Objective
from plr.controlplane.planning.prospects import Prospect
from plr.protos.base.errors import DecodeError
from plr.protos.convert import explanation_from_proto
from plr.protos.model.explanation import SAMPLE
from plr.protos.plr.v1 import admin_pb2
from plr.protos.program.regular_file import read_regular

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from plr.controlplane.core.problem.problem import Choice, PairIndex
    from plr.protos.base.histogram import Histogram
    from plr.protos.model.explanation import Explanation, PairExplanation
    from plr.protos.model.mapping import Assignment

MAX_CHOICES = 20_000
"""Most sets examined; if there are more, only the servers with the least epsilon of each interface are used."""

MAX_COUNTED_PROBES = 100.0
"""Beyond this many, probes no longer move a probability closer to 0 or 1: they are small."""

MIN_REQUESTS = 20.0
"""Requests that a pair must have carried before it shows how much slower requests are than probes."""


MAX_RECORDING_BYTES = 64 << 20
"""Longest recording: an answer takes some MB at most (16 interfaces, 4,096 servers)."""


class RecordingError(ValueError):
    """The file is not a recording; the text names the file."""


def read_recording(file: Path) -> Explanation:
    """Read what `plr explain --json` printed; raises RecordingError."""
    try:
        answer = json_format.Parse(_text(file), admin_pb2.ExplainResponse())
        return explanation_from_proto(answer)
    except OSError as error:
        raise RecordingError(f"{file}: cannot be read: {error.strerror or error}") from None
    except (UnicodeDecodeError, json_format.ParseError, DecodeError, RecursionError) as error:
        raise RecordingError(f"{file}: not an answer of plr explain --json: {' '.join(str(error).split())}") from None


def _text(file: Path) -> str:
    data = read_regular(file, MAX_RECORDING_BYTES + 1)
    if len(data) > MAX_RECORDING_BYTES:
        raise DecodeError(f"more than {MAX_RECORDING_BYTES} bytes")
    return data.decode()


class RecordedService:
    """One robot's service, at any deadline, with the latencies of the requests as they were sent."""

    def __init__(self, explanation: Explanation) -> None:
        self._explanation = explanation
        self._pairs = {pair.path: pair for pair in explanation.pairs if pair.network.total or pair.rtt.answered}
        self._overhead_s = _overhead(self._pairs.values())
        self.requests = max((pair.requests for pair in self._pairs.values()), default=0.0)
        self.title = (
            f"{explanation.robot} {explanation.service}: {len(self._pairs)} pairs with evidence,"
            f" at most {self.requests:.0f} requests each"
        )

    @property
    def deadline_s(self) -> float:
        """The deadline that the service had."""
        return self._explanation.deadline_s

    def prospects(self, deadline_s: float) -> list[Prospect]:
        """Return the best recorded set for each number of interfaces and servers."""
        if not self._pairs:
            return []
        block = self._block(deadline_s)
        choices = _choices(block)
        costs = objective_costs(Objective.JOINT, block, choices)
        best: dict[tuple[int, int], int] = {}
        for row in np.argsort(costs, kind="stable").tolist():
            used = [server for server in choices[row].tolist() if server >= 0]
            if used and (block.idempotent or len(set(used)) == 1):
                best.setdefault((len(used), len(set(used))), row)
        return [
            self._prospect(block, tuple(None if server < 0 else server for server in choices[best[key]].tolist()))
            for key in sorted(best)
        ]

    def _prospect(self, block: Block, choice: Choice) -> Prospect:
        used = [(i, j) for i, j in enumerate(choice) if j is not None]
        return Prospect(
            interfaces=len(used),
            servers=len({j for _, j in used}),
            paths=", ".join(f"{block.interfaces[i]} -> {block.servers[j]}" for i, j in used),
            product=math.prod(block.epsilon[i][j] or 1.0 for i, j in used),
            joint=joint_miss(block, choice),
        )

    def _block(self, deadline_s: float) -> Block:
        found = self._explanation
        interfaces = tuple(dict.fromkeys(path.interface for path in self._pairs))
        servers = tuple(dict.fromkeys(path.server for path in self._pairs))
        index = {path: (interfaces.index(path.interface), servers.index(path.server)) for path in self._pairs}
        epsilon: list[list[float | None]] = [[None] * len(servers) for _ in interfaces]
        for path, (i, j) in index.items():
            epsilon[i][j] = self._epsilon(path, deadline_s)
        lifts = self._lifts_through_servers(index, deadline_s)
        for pair, lift in self._lifts_between_interfaces(index, epsilon):
            lifts[pair] = max(lift, lifts.get(pair, 1.0))
        return Block(
            key=BlockKey(found.robot, found.service),
            interfaces=interfaces,
            servers=servers,
            epsilon=tuple(map(tuple, epsilon)),
            capacity=0,
            idempotent=found.idempotent,
            lifts=lifts,
        )

    def _epsilon(self, path: Assignment, deadline_s: float) -> float:
        pair = self._pairs[path]
        if deadline_s == self.deadline_s and pair.miss is not None:
            return pair.miss.mean
        network, later_s = self._network(pair)
        over = network.sum_exceeds(_distribution(pair.compute), deadline_s - later_s)
        samples = pair.network.total / SAMPLE or min(pair.probes, MAX_COUNTED_PROBES)
        return (over * samples + IGNORANCE.misses) / (samples + IGNORANCE.weight)

    def _network(self, pair: PairExplanation) -> tuple[Distribution, float]:
        """Return the network latency and what to add to it; a pair without requests is judged by its round trips."""
        of_requests = _distribution(pair.network)
        if of_requests is not None:
            return of_requests, 0.0
        of_probes = _distribution(pair.rtt)
        if of_probes is None:
            raise ValueError("a pair without evidence")
        return of_probes, self._overhead_s

    def _lifts_between_interfaces(
        self, index: Mapping[Assignment, PairIndex], epsilon: Sequence[Sequence[float | None]]
    ) -> Iterator[tuple[tuple[PairIndex, PairIndex], float]]:
        """Yield how much more often than by chance two paths miss together because their interfaces do.

        This holds whatever the servers. The factor is capped: both never miss more often than the better path alone.
        """
        for joint in self._explanation.joints:
            for (first, one), (second, other) in itertools.product(index.items(), repeat=2):
                if (first.interface, second.interface) != (joint.first, joint.second):
                    continue
                if joint.server in ((None,) if first.server != second.server else (first.server,)):
                    most = 1.0 / max(epsilon[one[0]][one[1]] or 1.0, epsilon[other[0]][other[1]] or 1.0)
                    yield (min(one, other), max(one, other)), min(max(1.0, joint.lift), most)

    def _lifts_through_servers(
        self, index: Mapping[Assignment, PairIndex], deadline_s: float
    ) -> dict[tuple[PairIndex, PairIndex], float]:
        """Return how much more often than by chance two paths to one server miss together, as it runs a request once.

        P(both miss) is the mean, over the server's computing time, of the product of the two probabilities that the
        network exceeds the remaining time.
        """
        lifts = {}
        for first, second in itertools.combinations(self._pairs.values(), 2):
            compute = _distribution(first.compute)
            if first.path.server != second.path.server or compute is None:
                continue
            shares, took = compute.used
            one, other = (
                network.over(deadline_s - later_s - took) for network, later_s in map(self._network, (first, second))
            )
            product = float(shares @ one) * float(shares @ other)
            if product > 0.0:
                here, there = sorted((index[first.path], index[second.path]))
                lifts[here, there] = float(shares @ (one * other)) / product
        return lifts


def _overhead(pairs: Collection[PairExplanation]) -> float:
    """Return how many seconds slower the network is, in the median, for requests than for probes."""
    found = [
        (pair.network.total, pair.network.quantile(0.5) - pair.rtt.quantile(0.5))
        for pair in pairs
        if pair.network.total >= MIN_REQUESTS * SAMPLE and pair.network.answered and pair.rtt.answered
    ]
    found = [(weight, excess) for weight, excess in found if math.isfinite(excess)]
    total = sum(weight for weight, _ in found)
    return sum(weight * max(0.0, excess) for weight, excess in found) / total if total else 0.0


def _distribution(histogram: Histogram) -> Distribution | None:
    """Return the histogram's distribution; None if it is empty."""
    total = histogram.total
    return Distribution.of(histogram.counts / total, histogram.lost / total) if total else None


def _choices(block: Block) -> NDArray[np.intp]:
    """Return every way to give each interface a server or none, one row each, with -1 for none."""
    share = max(1, int(MAX_CHOICES ** (1.0 / len(block.interfaces))) - 1)
    options = []
    for row in block.epsilon:
        known = [(epsilon, server) for server, epsilon in enumerate(row) if epsilon is not None]
        options.append([-1, *(server for _, server in sorted(known)[:share])])
    return np.array(list(itertools.product(*options)), dtype=np.intp)
