"""Defines access control: which robots may call which services on which clouds, and which clouds may offer them.

A policy is two lists of rules of patterns (`patterns.py`). A call is allowed when some rule under `offers` lets the
cloud offer the service, and some rule under `calls` lets the robot call the service on that cloud. What no rule allows
is denied; there are no rules that deny. Without any policy, everything is allowed (`permits.py`).
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING

from plr.controlplane.core.policy.patterns import matches
from plr.protos.model.members import NO_POLICY

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName, ServiceName

MAX_RULES = 1024
"""Maximum number of rules in one list."""

MAX_PATTERNS = 1024
"""Maximum number of patterns in one list of one rule."""

_FINGERPRINT_BYTES = 8


@dataclass(frozen=True, slots=True)
class CallRule:
    """These robots may call these services on these clouds."""

    robots: tuple[str, ...]
    services: tuple[str, ...]
    clouds: tuple[str, ...]

    def __str__(self) -> str:
        """Return it as written in the configuration."""
        return f"{{robots: {_listed(self.robots)}, services: {_listed(self.services)}, clouds: {_listed(self.clouds)}}}"

    def concerns(self, robot: NodeName) -> bool:
        """Return whether the rule is about this robot."""
        return matches(robot, self.robots)

    def lets_call(self, service: ServiceName, cloud: NodeName) -> bool:
        """Return whether the rule lets the robots it is about call the service on the cloud."""
        return self.leads_to(cloud) and matches(service, self.services)

    def leads_to(self, cloud: NodeName) -> bool:
        """Return whether the rule lets the robots it is about call anything there."""
        return matches(cloud, self.clouds)


@dataclass(frozen=True, slots=True)
class OfferRule:
    """These clouds may offer these services."""

    clouds: tuple[str, ...]
    services: tuple[str, ...]

    def __str__(self) -> str:
        """Return it as written in the configuration."""
        return f"{{clouds: {_listed(self.clouds)}, services: {_listed(self.services)}}}"

    def lets_offer(self, cloud: NodeName, service: ServiceName) -> bool:
        """Return whether the rule lets the cloud offer the service."""
        return matches(cloud, self.clouds) and matches(service, self.services)


@dataclass(frozen=True, slots=True)
class Policy:
    """All rules; their order does not matter."""

    calls: tuple[CallRule, ...] = ()
    offers: tuple[OfferRule, ...] = ()

    def offer_rule(self, cloud: NodeName, service: ServiceName) -> int | None:
        """Return the index of the first rule that lets the cloud offer the service."""
        return next((index for index, rule in enumerate(self.offers) if rule.lets_offer(cloud, service)), None)

    def call_rule(self, robot: NodeName, service: ServiceName, cloud: NodeName) -> int | None:
        """Return the index of the first rule that lets the robot call the service on the cloud, may that offer it or
        not."""
        for index, rule in enumerate(self.calls):
            if rule.lets_call(service, cloud) and rule.concerns(robot):
                return index
        return None

    def allows(self, robot: NodeName, service: ServiceName, cloud: NodeName) -> bool:
        """Return whether the robot may call the service on the cloud."""
        return self.offer_rule(cloud, service) is not None and self.call_rule(robot, service, cloud) is not None

    @property
    def fingerprint(self) -> int:
        """64 bits that differ between policies, and from the value that stands for no policy."""
        text = json.dumps(
            [
                [[rule.robots, rule.services, rule.clouds] for rule in self.calls],
                [[rule.clouds, rule.services] for rule in self.offers],
            ]
        )
        value = int.from_bytes(hashlib.sha256(text.encode()).digest()[:_FINGERPRINT_BYTES], "big")
        return max(value, NO_POLICY + 1)


def _listed(patterns: tuple[str, ...]) -> str:
    """Return a YAML list; quoted, since a star at the beginning means something else there."""
    return json.dumps(patterns)
