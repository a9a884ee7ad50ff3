"""Decides which pairs of an interface and a cloud mappings may use, by the operator's rules.

The first rule that matches a robot, one of its interfaces and a cloud decides; pairs that none matches are allowed.
This is about where requests should go, not about who may do what: that is the access policy's (`policy`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from plr.controlplane.core.policy.patterns import PatternIndex, matches

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence

    from plr.protos.model.ids import InterfaceName, NodeName

MAX_PATH_RULES = 1024
"""Maximum number of rules in the list."""

MAX_KEPT_VERDICTS = 65_536
"""Verdicts on pairs that are kept, of some hundred bytes each; beyond that, all are computed again."""


@dataclass(frozen=True, slots=True)
class PathRule:
    """Over these interfaces of these robots requests may, or may not, go to these clouds."""

    robots: tuple[str, ...]
    interfaces: tuple[str, ...]
    clouds: tuple[str, ...]
    allow: bool


class PathRules:
    """All rules, in order."""

    def __init__(self, rules: Sequence[PathRule] = ()) -> None:
        self._rules = tuple(rules)
        self._robots = PatternIndex(rule.robots for rule in self._rules)
        self._verdicts: dict[tuple[frozenset[int], InterfaceName, NodeName], bool] = {}

    def about(self, robot: NodeName) -> frozenset[int]:
        """Return the numbers of the rules that may match the robot."""
        return self._robots.matching(robot) if self._rules else frozenset()

    def barred(
        self, about: frozenset[int], interfaces: Iterable[InterfaceName], clouds: Collection[NodeName]
    ) -> frozenset[tuple[InterfaceName, NodeName]]:
        """Return which of these pairs may not be used by the mappings of a robot that these rules are `about`."""
        if not about:
            return frozenset()
        pairs = ((interface, cloud) for interface in interfaces for cloud in clouds)
        return frozenset(pair for pair in pairs if not self._allows(about, *pair))

    def _allows(self, about: frozenset[int], interface: InterfaceName, cloud: NodeName) -> bool:
        key = about, interface, cloud
        verdict = self._verdicts.get(key)
        if verdict is None:
            rules = (self._rules[number] for number in sorted(about))
            found = (rule for rule in rules if matches(interface, rule.interfaces) and matches(cloud, rule.clouds))
            first = next(found, None)
            if len(self._verdicts) >= MAX_KEPT_VERDICTS:
                self._verdicts.clear()
            verdict = self._verdicts[key] = first is None or first.allow
        return verdict
