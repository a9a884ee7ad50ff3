"""Explains the last mapping of a robot that is gone, out of what was known when it went."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from plr.controlplane.core.explain.explanation import UnknownNameError, explain, find_use
from plr.controlplane.core.formulation.block import Picture
from plr.controlplane.core.problem.plan import Plan
from plr.controlplane.core.problem.problem import BlockKey, Problem
from plr.protos.model.explanation import SAMPLE

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from plr.controlplane.core.estimate.estimator import Estimator, Evidence
    from plr.controlplane.core.estimate.shared_fate import CommonMisses
    from plr.controlplane.core.explain.departed import Departure, LastKnown
    from plr.controlplane.core.explain.explanation import Pairs
    from plr.controlplane.core.publish.history import MappingHistory
    from plr.protos.model.explanation import Explanation
    from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
    from plr.protos.model.mapping import Assignment
    from plr.protos.model.report import PenaltyReport


class _LastEstimates:
    """What was measured, as of the robot's departure: it does not fade, except for what others say of the servers."""

    def __init__(self, estimator: Estimator, last: LastKnown, now: float) -> None:
        self._estimator = estimator
        self._last = last
        self._now = now

    def path_up(self, robot: NodeName, interface: InterfaceName, server: NodeName) -> bool | None:
        path = self._last.paths.get((interface, server))
        return path.up if path is not None else None

    def penalties(self, robot: NodeName, now: float) -> Mapping[NodeName, PenaltyReport]:
        return self._estimator.penalties(robot, now)

    def observed_miss_ratio(self, robot: NodeName, service: ServiceName, now: float) -> float | None:
        return self._estimator.observed_miss_ratio(robot, service, now)

    def evidence(self, robot: NodeName, path: Assignment, service: ServiceName, now: float) -> Evidence:
        found = self._estimator.evidence(robot, path, service, now, servers_now=self._now)
        last = self._last.paths.get((path.interface, path.server))
        if last is None:
            return found
        return replace(found, probes=last.rtt.weight(now), rtt=last.rtt.scaled(now, SAMPLE))

    def common_misses(
        self, robot: NodeName, service: ServiceName, now: float
    ) -> Iterator[tuple[InterfaceName, InterfaceName, NodeName | None, CommonMisses]]:
        return self._estimator.common_misses(robot, service, now)


def explain_departed(
    gone: Departure,
    last: LastKnown | None,
    service: ServiceName,
    *,
    estimator: Estimator,
    history: MappingHistory,
    now: float,
) -> tuple[Explanation, Pairs]:
    """Explain it, as `explain` does. Its times count from the departure.

    Raises:
        UnknownNameError: it is forgotten, or knew no such service.
    """
    if last is None:
        raise UnknownNameError(
            f"{gone.name} is gone ({gone.why.value}), and what was known about it is forgotten; see: plr events --node "
            f"{gone.name}"
        )
    use = find_use(last.sidecar, service)
    key = BlockKey(gone.name, service)
    blocks = tuple(plan.block for plan in last.plans.values() if plan.block is not None)
    found, pairs = explain(
        last.sidecar,
        use,
        picture=Picture(Problem(blocks, {}, last.objective), last.notes),
        plan=Plan(last.plans),
        estimator=_LastEstimates(estimator, last, now),
        sent=last.mapping,
        sync=last.sync,
        history=history.of(key),
        clock=lambda: gone.at,
    )
    return replace(found, gone_s=max(0.0, now - gone.at), gone_why=gone.why), pairs
