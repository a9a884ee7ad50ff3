"""Filters a robot's report for pairs and services that it may use: nobody bears witness to anything else."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from plr.protos.model.ids import Role

if TYPE_CHECKING:
    from plr.controlplane.core.policy.permits import Permits
    from plr.controlplane.core.registry.registry import Registry
    from plr.protos.model.ids import NodeName, ServiceName
    from plr.protos.model.members import CallPermit
    from plr.protos.model.report import Report


def believable(report: Report, robot: NodeName, registry: Registry, permits: Permits) -> tuple[Report, int]:
    """Return what remains of a report, and how many of its entries were removed."""
    group = permits.group(robot)
    known: dict[NodeName, tuple[CallPermit | None, frozenset[ServiceName]]] = {}

    def of(server: NodeName) -> tuple[CallPermit | None, frozenset[ServiceName]]:
        found = known.get(server)
        if found is None:
            cloud = registry.get(server)
            is_cloud = cloud is not None and cloud.role is Role.CLOUD
            found = known[server] = (
                (permits.of(group, cloud), cloud.offered) if cloud and is_cloud else (None, frozenset())
            )
        return found

    def calls(server: NodeName, service: ServiceName) -> bool:
        permit, offered = of(server)
        return permit is not None and service in offered and service in permit

    latencies = tuple(one for one in report.latencies if calls(one.server, one.service))
    joints = tuple(
        one for one in report.joints if calls(one.first.server, one.service) and calls(one.second.server, one.service)
    )
    paths = tuple(one for one in report.paths if of(one.server)[0])
    penalties = tuple(one for one in report.penalties if of(one.server)[0])
    left_out = _entries(report) - (len(latencies) + len(joints) + len(paths) + len(penalties))
    if not left_out:
        return report, 0
    return replace(report, latencies=latencies, joints=joints, paths=paths, penalties=penalties), left_out


def _entries(report: Report) -> int:
    return len(report.latencies) + len(report.joints) + len(report.paths) + len(report.penalties)
