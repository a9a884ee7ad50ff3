"""Finds whom the access policy leaves nobody to talk to: to its peers, such a member is as good as gone."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.protos.model.ids import Role

if TYPE_CHECKING:
    from collections.abc import Iterable

    from plr.controlplane.core.policy.permits import Permits
    from plr.controlplane.core.registry.registry import Sidecar
    from plr.protos.model.ids import NodeName


def cut_off(sidecars: Iterable[Sidecar], permits: Permits) -> frozenset[NodeName]:
    """Return the sidecars that may have to do with none of the others.

    Nobody is cut off if there is nobody to talk to. A cloud that has not offered anything yet is not cut off either, as
    nobody knows yet what robots may call there.
    """
    if not permits.restricted:
        return frozenset()
    members = list(sidecars)
    clouds = [cloud for cloud in members if cloud.role is Role.CLOUD and cloud.offered]
    groups = {robot.name: permits.group(robot.name) for robot in members if robot.role is Role.ROBOT}
    if not clouds or not groups:
        return frozenset()
    served = frozenset[int]().union(*(permits.rules_that_serve(cloud) for cloud in clouds))
    asking = frozenset[int]().union(*set(groups.values()))
    lonely_groups = {group for group in set(groups.values()) if group.isdisjoint(served)}
    lonely = {name for name, group in groups.items() if group in lonely_groups}
    lonely.update(cloud.name for cloud in clouds if asking.isdisjoint(permits.rules_that_serve(cloud)))
    return frozenset(lonely)
