"""Robot side: which services exist on the robot, following the live servers.

A service is offered from its first server within reach on. When there is none any more, as all paths are dark or as the
servers themselves are gone, the offer stays for WITHDRAW_AFTER_S, or for the lifetime of a request where that is
longer: they may be in a tunnel or restarting, and requests wait for the first that comes back. With the offer end the
requests that still wait at it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from protos.model import ServiceUse
from sidecar.core.events import OfferService, WithdrawService
from sidecar.core.rules import find_rule

if TYPE_CHECKING:
    from collections.abc import Mapping

    from protos.model import NodeName, Peer, ServiceName
    from sidecar.core.routes import Routes
    from sidecar.core.rules import ServiceRule

WITHDRAW_AFTER_S = 15.0
"""Longer than a handover, a tunnel or the restart of a server, shorter than a person's patience with a dead service."""


class Offers:
    """Services offered on the robot, and the servers behind each."""

    def __init__(self, rules: tuple[ServiceRule, ...]) -> None:
        self._rules = rules
        self._offered: dict[ServiceName, str] = {}
        self._wanted: dict[ServiceName, tuple[str, tuple[NodeName, ...]]] = {}
        """Service -> (type, servers), as the peers offer it."""
        self._gained: set[ServiceName] = set()
        """Of the wanted ones, those that got another server since somebody asked."""
        self._dark_until: dict[ServiceName, float] = {}
        """Service without a server in reach -> when its offer ends."""
        self.conflicts: set[tuple[ServiceName, NodeName, str]] = set()
        """Servers left out because they offer another type than the rest."""

    @property
    def offered(self) -> dict[ServiceName, str]:
        """Service names and types offered now."""
        return self._offered

    def servers(self, service: ServiceName) -> tuple[NodeName, ...]:
        """Return the servers that a new request for this service may go to."""
        wanted = self._wanted.get(service)
        return wanted[1] if wanted else ()

    def update(self, routes: Routes, now: float) -> list[OfferService | WithdrawService]:
        """Follow the peers' offers and the paths to them; returns what changes on the robot."""
        reached = {
            name: kind
            for name, (kind, servers) in self._wanted.items()
            if any(routes.reaches(server) for server in servers)
        }
        events: list[OfferService | WithdrawService] = []
        for name, kind in list(self._offered.items()):
            if name not in reached:
                patience_s = self._patience_s(name)
                if self._dark_until.setdefault(name, now + patience_s) <= now:
                    seconds = f"{patience_s:g} s"
                    dark = name in self._wanted
                    why = f"no path to a server for {seconds}" if dark else f"no live server for {seconds}"
                    events.append(self._withdraw(name, why))
            elif reached[name] != kind:
                events.append(self._withdraw(name, f"its servers offer it as {reached[name]} now"))
        for name, kind in reached.items():
            self._dark_until.pop(name, None)
            if name not in self._offered:
                self._offered[name] = kind
                events.append(OfferService(name, kind))
        return events

    def _withdraw(self, name: ServiceName, reason: str) -> WithdrawService:
        del self._offered[name]
        self._dark_until.pop(name, None)
        return WithdrawService(name, reason)

    def _patience_s(self, name: ServiceName) -> float:
        rule = find_rule(self._rules, name)
        return max(WITHDRAW_AFTER_S, rule.lifetime_s) if rule else WITHDRAW_AFTER_S

    def uses(self, carried: Mapping[ServiceName, bool | None]) -> tuple[ServiceUse, ...]:
        """Return the offered services of these, as the control plane is told of them.

        `carried` tells whether their fallbacks can be asked.
        """
        uses = []
        for name, kind in self._offered.items():
            rule = find_rule(self._rules, name)
            if rule is not None and name in carried:
                wanted = (rule.deadline_s, rule.idempotent, rule.copies, rule.target_miss)
                uses.append(ServiceUse(name, kind, *wanted, fallback_up=carried[name]))
        return tuple(uses)

    def set_peers(self, peers: list[Peer]) -> None:
        """Take what the peers offer; servers that drain count only where there is no other."""
        by_name: dict[ServiceName, dict[str, list[Peer]]] = {}
        for peer in peers:
            for offer in peer.offers:
                if find_rule(self._rules, offer.name) is not None:
                    by_name.setdefault(offer.name, {}).setdefault(offer.type, []).append(peer)
        before, self._wanted = self._wanted, {}
        self.conflicts = set()
        for name, by_type in by_name.items():
            current = self._offered.get(name)
            # Most servers win; the type already offered wins a tie, so that one odd server changes nothing.
            kind = max(sorted(by_type), key=lambda kind: (len(by_type[kind]), kind == current))
            self.conflicts.update(
                (name, peer.name, other) for other, others in by_type.items() if other != kind for peer in others
            )
            fresh = [peer.name for peer in by_type[kind] if not peer.draining]
            servers = tuple(fresh or [peer.name for peer in by_type[kind]])
            self._wanted[name] = (kind, servers)
            if name not in before or not set(servers) <= set(before[name][1]):
                self._gained.add(name)
        self._gained &= self._wanted.keys()  # a cloud's sidecar never asks

    def take_gained(self) -> set[ServiceName]:
        """Return the services that got another server since the last call."""
        gained, self._gained = self._gained, set()
        return gained

    def next_timer(self) -> float | None:
        """When the first darkness ends an offer."""
        return min(self._dark_until.values(), default=None)
