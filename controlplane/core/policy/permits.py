"""Applies the policy to the sidecars that are present, and keeps the results until the policy changes.

A publication asks for every robot and every cloud. So the rules about each name are looked up once, and what they
allow each cloud is kept; what is left for a robot and a cloud is to compare sets of rules. Robots covered by the same
rules form a group and may do the same.

To look up a name takes microseconds, or a millisecond if the policy has thousands of patterns that differ between their
stars only. A driver that may not stop for that many times looks up ahead (`look_up`, `prepare`).
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

from plr.controlplane.core.policy.patterns import PatternIndex
from plr.protos.model.ids import NodeName, Role, ServiceName
from plr.protos.model.members import ALL_CALLS, MAX_SIDECARS, NO_POLICY, CallPermit

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from plr.controlplane.core.policy.policy import Policy
    from plr.controlplane.core.registry.registry import Sidecar

MAX_GROUPED = 2 * MAX_SIDECARS
"""Sidecars of which the rules about them are kept; beyond that, all are computed again."""

MAX_KEPT_PERMITS = 65_536
"""Permits kept, of some hundred bytes each, and services of which the rules about them are; beyond that, all are
computed again."""

MAX_KEPT_RULES = 1_000_000
"""Numbers of rules kept in all different sets of them; beyond that, all are computed again."""

Group = frozenset[int]
"""Indices of the `calls` rules that are about a robot."""

_Name = TypeVar("_Name", NodeName, ServiceName)


class _Rules(Generic[_Name]):
    """Indices of the rules about names, kept. Equal ones are the same object: most names are like many others."""

    def __init__(self, lists: Iterable[tuple[str, ...]], most: int) -> None:
        self._index = PatternIndex(lists)
        self._most = most
        self._about: dict[_Name, frozenset[int]] = {}
        self._different: dict[frozenset[int], frozenset[int]] = {}
        self._kept = 0
        """Their members."""

    def __contains__(self, name: _Name) -> bool:
        """Return whether the rules about this name are known already."""
        return name in self._about

    def about(self, name: _Name) -> frozenset[int]:
        """Return the indices of the rules about a name."""
        known = self._about.get(name)
        if known is None:
            found = self._index.matching(name)
            if len(self._about) >= self._most or self._kept >= MAX_KEPT_RULES:
                self._about.clear()
                self._different.clear()
                self._kept = 0
            known = self._different.get(found)
            if known is None:
                known = self._different[found] = found
                self._kept += len(found)
            self._about[name] = known
        return known


@dataclass(frozen=True, slots=True)
class _Served:
    """What a cloud has offered since it registered, by the call rules about it, and what of that it may not offer."""

    offered: frozenset[ServiceName]
    refused: frozenset[ServiceName]
    by_rules: tuple[tuple[frozenset[int], frozenset[ServiceName]], ...]
    rules: frozenset[int]
    """All these rules."""


class Permits:
    """What robots may call and clouds may offer; without a policy, everything."""

    def __init__(self, policy: Policy | None) -> None:
        self._policy = policy
        calls = policy.calls if policy is not None else ()
        offers = policy.offers if policy is not None else ()
        self._callers = _Rules[NodeName]((rule.robots for rule in calls), MAX_GROUPED)
        self._called_clouds = _Rules[NodeName]((rule.clouds for rule in calls), MAX_GROUPED)
        self._called = _Rules[ServiceName]((rule.services for rule in calls), MAX_KEPT_PERMITS)
        self._offering = _Rules[NodeName]((rule.clouds for rule in offers), MAX_GROUPED)
        self._offered = _Rules[ServiceName]((rule.services for rule in offers), MAX_KEPT_PERMITS)
        self._served: dict[NodeName, _Served] = {}
        self._permits: dict[tuple[Group, NodeName], tuple[_Served, CallPermit]] = {}
        self.fingerprint = NO_POLICY if policy is None else policy.fingerprint

    @property
    def restricted(self) -> bool:
        """Whether there is a policy."""
        return self._policy is not None

    def group(self, robot: NodeName) -> Group:
        """Return the group of a robot."""
        return self._callers.about(robot) if self._policy is not None else frozenset()

    def of(self, group: Group, cloud: Sidecar) -> CallPermit:
        """Return what the robots of a group may call on a cloud, of all it offered since it registered.

        Not only its present offers count: a server that is away for a moment must not cost its robots their place.
        """
        if self._policy is None:
            return ALL_CALLS
        served = self._serve(cloud)
        known = self._permits.get((group, cloud.name))
        if known is not None and known[0] is served:
            return known[1]
        parts = [names for rules, names in served.by_rules if not group.isdisjoint(rules)]
        permit = CallPermit(parts[0] if len(parts) == 1 else frozenset[ServiceName]().union(*parts))
        if len(self._permits) >= MAX_KEPT_PERMITS:
            self._permits.clear()
        self._permits[group, cloud.name] = served, permit
        return permit

    def rules_that_serve(self, cloud: Sidecar) -> Group:
        """Return the indices of the call rules that let the robots they are about call something on a cloud."""
        return self._serve(cloud).rules

    def may_meet(self, robot: NodeName, cloud: Sidecar) -> bool:
        """Return whether a robot may call anything on a cloud."""
        return self._policy is None or bool(self.of(self.group(robot), cloud))

    def may_know(self, robot: NodeName, cloud: NodeName) -> bool:
        """Return whether a robot may call anything on a cloud of which only the name is known."""
        return self.group_may_know(self.group(robot), cloud)

    def group_may_know(self, group: Group, cloud: NodeName) -> bool:
        """Return the same for all robots of a group."""
        return self._policy is None or not group.isdisjoint(self._called_clouds.about(cloud))

    def may_offer(self, cloud: NodeName, service: ServiceName) -> bool:
        """Return whether a cloud may offer a service."""
        if self._policy is None:
            return True
        served = self._served.get(cloud)
        if served is not None and service in served.offered:
            return service not in served.refused
        return not self._offering.about(cloud).isdisjoint(self._offered.about(service))

    def refused_offers(self, cloud: Sidecar) -> tuple[ServiceName, ...]:
        """Return what a cloud offers now and may not."""
        if self._policy is None or not cloud.offers:
            return ()
        refused = self._serve(cloud).refused
        return tuple(offer.name for offer in cloud.offers if offer.name in refused)

    def not_looked_up(self, services: Iterable[ServiceName]) -> list[ServiceName]:
        """Return those of the services for which `look_up` has something to do."""
        if self._policy is None:
            return []
        return [name for name in services if name not in self._called or name not in self._offered]

    def look_up(self, service: ServiceName) -> None:
        """Look up the rules about a service ahead of the cloud that announces it."""
        self._called.about(service)
        self._offered.about(service)

    def prepare(self, sidecars: Iterable[Sidecar]) -> Iterator[None]:
        """Do ahead, in small steps, what the other methods would do for these sidecars when asked."""
        if self._policy is None:
            return
        for sidecar in sidecars:
            if sidecar.role is Role.ROBOT:
                self.group(sidecar.name)
                yield
                continue
            for service in self.not_looked_up(sidecar.offered):
                self.look_up(service)
                yield
            self._serve(sidecar)
            yield

    def _serve(self, cloud: Sidecar) -> _Served:
        known = self._served.get(cloud.name)
        if known is not None and (known.offered is cloud.offered or known.offered == cloud.offered):
            return known
        lets_offer, lead_here = self._offering.about(cloud.name), self._called_clouds.about(cloud.name)
        by_offer_rules: defaultdict[frozenset[int], set[ServiceName]] = defaultdict(set)
        for service in cloud.offered:
            by_offer_rules[self._offered.about(service)].add(service)
        refused: set[ServiceName] = set()
        by_call_rules: defaultdict[frozenset[int], set[ServiceName]] = defaultdict(set)
        for rules, services in by_offer_rules.items():
            if lets_offer.isdisjoint(rules):
                refused |= services
                continue
            for service in services:
                by_call_rules[self._called.about(service)].add(service)
        by_rules = tuple(
            (rules if rules <= lead_here else rules & lead_here, frozenset(services))
            for rules, services in by_call_rules.items()
            if not rules.isdisjoint(lead_here)
        )
        every = by_rules[0][0] if len(by_rules) == 1 else frozenset[int]().union(*(rules for rules, _ in by_rules))
        if len(self._served) >= MAX_GROUPED:
            self._served.clear()
        served = self._served[cloud.name] = _Served(cloud.offered, frozenset(refused), by_rules, every)
        return served
