"""Decides which services a robot offers to its local applications, from the network's offers and the local graph."""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING

from plr.protos.model.ids import ServiceName
from plr.sidecar.core.rules.service_rule import Rules
from plr.sidecar.ros.errors import RosBridgeError
from plr.sidecar.ros.graph import graph
from plr.sidecar.ros.robot.service_proxy import ServiceProxy
from plr.sidecar.ros.types import TypeNotInstalledError, load_service_type

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from plr.sidecar.core.rules.service_rule import ServiceRule
    from plr.sidecar.core.seam.application import OfferService, WithdrawService
    from plr.sidecar.ros.ros_loop import RosLoop
    from plr.sidecar.ros.stats import BridgeStats

DISCOVERY_SETTLES_S = 1.0
"""How long nothing is offered after joining the domain: servers already running here must be discovered first."""
NAME_IS_FREE_S = 0.15
"""How long nobody else must have served a name. If robot and cloud share a domain, the cloud's sidecar may have
discovered the server whose service we are offered a moment before ours does."""
TYPE_RETRY_S = 30.0
"""How often a type that is not installed is tried again: someone may be installing it."""

log = logging.getLogger(__name__)


class Proxies:
    """The proxied services. A name that another local node serves is left alone."""

    def __init__(
        self,
        *,
        loop: RosLoop,
        rules: tuple[ServiceRule, ...],
        stats: BridgeStats,
        now: float,
        on_closed: Callable[[ServiceProxy, int], None],
    ) -> None:
        """Call `on_closed` with the number of requests that waited unseen at the closed proxy."""
        self._loop = loop
        self._own_node = loop.node.get_fully_qualified_name()
        self._rules = Rules(rules)
        self._configured = {ServiceName(rule.pattern): rule.type for rule in rules if rule.type and rule.is_name}
        """Types that the configuration names; those that prove to be installed are removed."""
        self._stats = stats
        self._on_closed = on_closed
        self.offers: dict[ServiceName, str] = {}
        """Services that servers in the network offer, with their types."""
        self._proxies: dict[ServiceName, ServiceProxy] = {}
        self._missing_types: dict[ServiceName, str] = {}
        self._left_alone: dict[ServiceName, frozenset[str]] = {}
        self._free_since: dict[ServiceName, float] = {}
        self._types_retried_at = 0.0
        self._configured_tried_at = -math.inf
        self.settling = False
        """Whether a name is about to be free, so that another scan is needed soon."""
        self._settled_at = now + DISCOVERY_SETTLES_S

    def offer(self, event: OfferService) -> None:
        """Note that a server in the network offers a service."""
        if self._rules.find(event.name) is None:
            self._stats.dropped["offer_not_in_rules"] += 1
            log.error("service %s is offered, but no rule of this sidecar carries it", event.name)
            return
        if self.offers.get(event.name) != event.type:
            proxy = self._proxies.get(event.name)
            if proxy is not None and proxy.type.name != event.type:
                self._close_proxy(event.name)
            self._missing_types.pop(event.name, None)
        self.offers[event.name] = event.type

    def withdraw(self, event: WithdrawService, fallbacks: Mapping[ServiceName, str]) -> None:
        """Note that no server in the network offers it any more; `fallbacks`: services with one here, and its type."""
        if self.offers.pop(event.name, None) is None:
            return
        self._missing_types.pop(event.name, None)
        self._left_alone.pop(event.name, None)
        self._free_since.pop(event.name, None)
        proxy = self._proxies.get(event.name)
        if proxy is not None and fallbacks.get(event.name) == proxy.type.name:
            log.warning("service %s: only its fallback answers from now on: %s", event.name, event.reason)
        elif self._close_proxy(event.name):
            log.warning("service %s is withdrawn: %s", event.name, event.reason)
        self._publish_state()

    def try_configured_types(self, now: float) -> Iterator[None]:
        """Look in steps whether the types that the configuration names are installed, before any server offers them."""
        if not self._configured or now < self._configured_tried_at + TYPE_RETRY_S:
            return
        self._configured_tried_at = now
        for name, type_name in list(self._configured.items()):
            if name not in self.offers:
                self._try_configured(name, type_name)
                yield
        self._publish_state()

    def follow(
        self, served: Mapping[ServiceName, graph.Served], fallbacks: Mapping[ServiceName, str], now: float
    ) -> Iterator[None]:
        """Compare the graph with what should be offered, in steps; create and withdraw proxies accordingly."""
        self.settling = False
        # Services with a fallback are offered even without any server.
        wanted = {**fallbacks, **self.offers}
        for name in [name for name in self._proxies if name not in wanted]:
            self._close_proxy(name)
            log.warning("service %s is withdrawn: no server, and its fallback is gone", name)
            yield
        retry_types = now - self._types_retried_at >= TYPE_RETRY_S
        if retry_types:
            self._types_retried_at = now
        for name, type_name in wanted.items():
            yield
            if name not in self.offers and name not in fallbacks:
                continue  # withdrawn since the last step
            others = self._servers_in_our_way(name, served.get(name))
            if others:
                self._free_since.pop(name, None)
                self._leave_alone(name, others)
                continue
            free_since = self._free_since.setdefault(name, now)
            if now < self._settled_at or now - free_since < NAME_IS_FREE_S:
                self.settling = True
                continue
            if self._left_alone.pop(name, None):
                log.info("service %s: no other node serves it any more", name)
            if name not in self._proxies and (retry_types or name not in self._missing_types):
                self._open_proxy(name, type_name)
        self._publish_state()

    def _servers_in_our_way(self, name: ServiceName, served: graph.Served | None) -> frozenset[str]:
        if served is None:
            return frozenset()
        others = served.nodes() - {self._own_node}
        if name not in self._proxies:
            return others
        # If two robot sidecars in one domain proxied the name at the same moment, the smaller node name stays.
        return frozenset(node for node in others if not graph.is_sidecar(node) or node < self._own_node)

    def _leave_alone(self, name: ServiceName, others: frozenset[str]) -> None:
        if self._left_alone.get(name) == others:
            return
        self._left_alone[name] = others
        nodes = ", ".join(sorted(others))
        if self._close_proxy(name):
            log.warning("service %s is now served by %s on this robot: the sidecar withdraws its own", name, nodes)
        else:
            log.warning("service %s is already served by %s on this robot: left alone", name, nodes)

    def _try_configured(self, name: ServiceName, type_name: str) -> None:
        try:
            load_service_type(type_name)
        except RosBridgeError as error:
            self._note_missing_type(name, type_name, error)
            return
        del self._configured[name]
        if self._missing_types.pop(name, None) is not None:
            log.info("service %s: its type %s is installed now", name, type_name)

    def _note_missing_type(self, name: ServiceName, type_name: str, error: RosBridgeError) -> None:
        if name not in self._missing_types:
            self._missing_types[name] = type_name
            kind = "type_not_installed" if isinstance(error, TypeNotInstalledError) else "service_refused"
            self._stats.errors[kind] += 1
            log.error("service %s is not offered here: %s", name, error)

    def _open_proxy(self, name: ServiceName, type_name: str) -> None:
        try:
            proxy = ServiceProxy(self._loop.node, name, load_service_type(type_name))
        except RosBridgeError as error:
            self._note_missing_type(name, type_name, error)
            return
        self._missing_types.pop(name, None)
        self._proxies[name] = proxy
        self._loop.set_services(tuple(self._proxies.values()))
        log.info("service %s (%s) is offered here", name, type_name)

    def _close_proxy(self, name: ServiceName) -> bool:
        proxy = self._proxies.pop(name, None)
        if proxy is None:
            return False
        self._loop.set_services(tuple(self._proxies.values()))
        self._on_closed(proxy, proxy.close())
        return True

    def _publish_state(self) -> None:
        self._stats.left_alone = {name: tuple(sorted(nodes)) for name, nodes in self._left_alone.items()}
        self._stats.missing_types = dict(self._missing_types)
        self._stats.carried = frozenset(self._proxies)

    def close(self) -> None:
        """Withdraw every proxy."""
        for name in tuple(self._proxies):
            self._close_proxy(name)
        self.offers.clear()
        self._publish_state()
