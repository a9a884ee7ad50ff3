"""Decides which services are carried, and how: by the configuration's rules, matched by name.

The first rule that matches wins. The fallback of a rule is never carried itself. Parameter and lifecycle services of
nodes are carried only if a rule names them exactly: a glob such as /* must not open every node's parameters to other
machines.
"""

from __future__ import annotations

import fnmatch
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from plr.protos.model.members import EVERY_INTERFACE, Copies
from plr.protos.model.redundancy_mode import DEFAULT_ADAPTIVE_TARGET, DEFAULT_HEDGE_QUANTILE, RedundancyMode
from plr.sidecar.core.base.values import Priority

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from plr.protos.model.ids import ServiceName
    from plr.sidecar.core.message.repair import Redundancy

DEFAULT_REPEATS = 1.0
"""With less, a path that goes dark costs a probe timeout: not all that it carried has been repeated."""


@dataclass(frozen=True, slots=True)
class FallbackRule:
    """The fallback of one service."""

    service: ServiceName
    """A service of the same type that a node on this robot serves; never carried itself."""
    in_time: bool = True
    """Ask it early enough to answer by the deadline; else only once the network has missed."""
    takes_s: float | None = None
    """Longest time that it takes; None: as measured."""


MAX_LIFETIME_S = 300.0
"""A request that may wait longer is a job, not a call. A server remembers every request for longer than this."""

MAX_FOUND = 8192
"""Names whose rule is cached; one more empties the cache."""

_GLOB_CHARACTERS = frozenset("*?[")
_NODE_INTERNAL_SUFFIXES = frozenset(
    {
        # rclcpp and rclpy parameter services
        "describe_parameters",
        "get_parameter_types",
        "get_parameters",
        "list_parameters",
        "set_parameters",
        "set_parameters_atomically",
        "get_type_description",
        # managed nodes
        "change_state",
        "get_state",
        "get_available_states",
        "get_available_transitions",
        "get_transition_graph",
    }
)


@dataclass(frozen=True, slots=True)
class ServiceRule:
    """How the services whose name matches `pattern` (exact or glob) are carried."""

    pattern: str
    deadline_s: float
    lifetime_s: float
    """A request without a response is given up after this long, at most MAX_LIFETIME_S."""
    idempotent: bool = False
    """Copies of one request may run on several servers."""
    type: str = ""
    """Robot: the type that servers must offer; empty: the type that most of them offer."""
    drop_late: bool = False
    """A response after the deadline is not delivered."""
    priority: Priority = Priority.NORMAL
    """Which messages and executions go first where something waits."""
    fec: Redundancy = None
    """Repair symbols for each source symbol of messages sent from here; None: by the measured loss."""
    redundancy: RedundancyMode = RedundancyMode.REPLICATE
    """Robot: which of the mapped pairs carry a copy, and when."""
    hedge_quantile: float = DEFAULT_HEDGE_QUANTILE
    """Robot, with RedundancyMode.HEDGE: the share of first copies that is waited for."""
    adaptive_target: float = DEFAULT_ADAPTIVE_TARGET
    """Robot, with RedundancyMode.ADAPTIVE: the probability of a deadline miss that further copies are to keep."""
    repeats: float = DEFAULT_REPEATS
    """Robot, with RedundancyMode.SHARE: the share of a request that its paths may repeat."""
    copies: Copies = EVERY_INTERFACE
    """Robot: how many copies of a request the control plane may map."""
    target_miss: float = 0.0
    """Robot: above 0, the cheapest mapping that misses at most this often is wanted; 0: the most reliable one."""
    wanted_miss: float = 0.0
    """Robot: the share of misses that the configuration allows, whatever is done about it; 0: none named."""
    exploration: float = 0.0
    """Robot: at most this share of the requests gets one more copy over a path that the mapping does not use."""
    fallback: FallbackRule | None = None
    """Robot: what answers here when the network does not; `pattern` is then a name."""
    capacity: int = 0
    """Cloud: number of robot interfaces that may be mapped here; 0 means no limit."""
    cost_per_request: float = 0.0
    """Cloud: cost of a request that runs here."""

    @property
    def is_name(self) -> bool:
        """Whether `pattern` is the name of one service, not a glob."""
        return not _GLOB_CHARACTERS.intersection(self.pattern)


class Rules:
    """The configuration's rules in their order, asked by name.

    A node asks about the same names again and again, for every request and every peer's offers, so results are cached.
    """

    __slots__ = ("_exact", "_fallbacks", "_found", "_globs")

    def __init__(self, rules: Iterable[ServiceRule]) -> None:
        self._exact: dict[str, tuple[int, ServiceRule]] = {}
        self._globs: list[tuple[int, Callable[[str], object], ServiceRule]] = []
        self._fallbacks: set[str] = set()
        self._found: dict[ServiceName, ServiceRule | None] = {}
        for index, rule in enumerate(rules):
            self._exact.setdefault(rule.pattern, (index, rule))
            if _GLOB_CHARACTERS.intersection(rule.pattern):
                self._globs.append((index, re.compile(fnmatch.translate(rule.pattern)).match, rule))
            if rule.fallback is not None:
                self._fallbacks.add(rule.fallback.service)

    def find(self, name: ServiceName) -> ServiceRule | None:
        """Return the rule under which the service is carried, or None if it is not."""
        try:
            return self._found[name]
        except KeyError:
            pass
        if len(self._found) >= MAX_FOUND:
            self._found.clear()  # peers name services: inventing names costs time, not memory
        found = self._found[name] = self._search(name)
        return found

    def _search(self, name: ServiceName) -> ServiceRule | None:
        if name in self._fallbacks:
            return None
        first = self._exact.get(name)
        if name.rsplit("/", 1)[-1] in _NODE_INTERNAL_SUFFIXES or "/_action/" in name:
            return None if first is None else first[1]
        for index, matches, rule in self._globs:
            if first is not None and first[0] < index:
                break
            if matches(name):
                return rule
        return None if first is None else first[1]
