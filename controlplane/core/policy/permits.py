"""Applies the policy to the sidecars that are present, and keeps the results until the policy changes.

A publication asks for every robot and every cloud. Robots covered by the same rules form a group and may do the same,
so that the rules are tried once for each group and cloud, not for each robot.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.controlplane.core.policy.patterns import PatternIndex
from plr.protos.model.members import ALL_CALLS, MAX_SIDECARS, NO_POLICY, CallPermit

if TYPE_CHECKING:
    from plr.controlplane.core.policy.policy import Policy
    from plr.controlplane.core.registry.registry import Sidecar
    from plr.protos.model.ids import NodeName, ServiceName

MAX_GROUPED = 2 * MAX_SIDECARS
"""Robots whose group is kept; beyond that, all are computed again."""

MAX_KEPT_PERMITS = 65_536
"""Permits kept, of some hundred bytes each, and verdicts on offers; beyond that, all are computed again."""

Group = frozenset[int]
"""Indices of the `calls` rules that are about a robot."""


class Permits:
    """What robots may call and clouds may offer; without a policy, everything."""

    def __init__(self, policy: Policy | None) -> None:
        self._policy = policy
        self._robots = PatternIndex(rule.robots for rule in (policy.calls if policy else ()))
        self._clouds = PatternIndex(rule.clouds for rule in (policy.offers if policy else ()))
        self._groups: dict[NodeName, Group] = {}
        self._may_offer: dict[tuple[NodeName, ServiceName], bool] = {}
        self._permits: dict[tuple[Group, NodeName], tuple[frozenset[ServiceName], CallPermit]] = {}
        self.fingerprint = NO_POLICY if policy is None else policy.fingerprint

    @property
    def restricted(self) -> bool:
        """Whether there is a policy."""
        return self._policy is not None

    def group(self, robot: NodeName) -> Group:
        """Return the group of a robot."""
        if self._policy is None:
            return frozenset()
        group = self._groups.get(robot)
        if group is None:
            group = self._robots.matching(robot)
            if len(self._groups) >= MAX_GROUPED:
                self._groups.clear()
            self._groups[robot] = group
        return group

    def of(self, group: Group, cloud: Sidecar) -> CallPermit:
        """Return what the robots of a group may call on a cloud, of all it offered since it registered.

        Not only its present offers count: a server that is away for a moment must not cost its robots their place.
        """
        if self._policy is None:
            return ALL_CALLS
        known = self._permits.get((group, cloud.name))
        if known is not None and (known[0] is cloud.offered or known[0] == cloud.offered):
            return known[1]
        rules = [self._policy.calls[index] for index in group]
        names = frozenset(
            service
            for service in cloud.offered
            if self.may_offer(cloud.name, service) and any(rule.lets_call(service, cloud.name) for rule in rules)
        )
        permit = CallPermit(names)
        if len(self._permits) >= MAX_KEPT_PERMITS:
            self._permits.clear()
        self._permits[group, cloud.name] = (cloud.offered, permit)
        return permit

    def may_meet(self, robot: NodeName, cloud: Sidecar) -> bool:
        """Return whether a robot may call anything on a cloud."""
        return self._policy is None or bool(self.of(self.group(robot), cloud))

    def may_know(self, robot: NodeName, cloud: NodeName) -> bool:
        """Return whether a robot may call anything on a cloud of which only the name is known."""
        return self.group_may_know(self.group(robot), cloud)

    def group_may_know(self, group: Group, cloud: NodeName) -> bool:
        """Return the same for all robots of a group."""
        if self._policy is None:
            return True
        return any(self._policy.calls[index].leads_to(cloud) for index in group)

    def may_offer(self, cloud: NodeName, service: ServiceName) -> bool:
        """Return whether a cloud may offer a service."""
        if self._policy is None:
            return True
        known = self._may_offer.get((cloud, service))
        if known is None:
            rules = (self._policy.offers[index] for index in self._clouds.matching(cloud))
            known = any(rule.lets_offer(cloud, service) for rule in rules)
            if len(self._may_offer) >= MAX_KEPT_PERMITS:
                self._may_offer.clear()
            self._may_offer[cloud, service] = known
        return known

    def refused_offers(self, cloud: Sidecar) -> tuple[ServiceName, ...]:
        """Return what a cloud offers now and may not."""
        return tuple(offer.name for offer in cloud.offers if not self.may_offer(cloud.name, offer.name))
