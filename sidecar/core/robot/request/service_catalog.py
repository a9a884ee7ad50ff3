"""Robot side: decides which services exist on the robot, following the live servers.

A service is offered once its first server is within reach. When none is left, because all paths are dark or the servers
themselves are gone, the offer stays for WITHDRAW_AFTER_S, or for the lifetime of a request if that is longer: the robot
may be in a tunnel or the servers restarting, and requests wait for the first that comes back. When the offer ends, so
do the requests that still wait at it.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING, NamedTuple

from plr.protos.model.members import ServiceUse
from plr.sidecar.core.base.fair_share import Shares
from plr.sidecar.core.seam.application import OfferService, WithdrawService

if TYPE_CHECKING:
    from collections.abc import Container, Iterable

    from plr.protos.model.ids import NodeName, ServiceName
    from plr.protos.model.members import Peer
    from plr.sidecar.core.rules.service_rule import Rules, ServiceRule
    from plr.sidecar.core.seam.application import CarriedService
    from plr.sidecar.core.seam.stats import EngineStats
    from plr.sidecar.core.transfer.routes import Routes

MAX_TYPES = 2048
"""Services whose type is remembered; beyond that the one noted longest ago goes. Peers invent names under a glob."""

MAX_OFFERED_SERVICES = 512
"""Services offered on the robot; each costs DDS endpoints and a slot in every wait. One peer may have half."""
WITHDRAW_AFTER_S = 15.0
"""Longer than a handover, a tunnel or the restart of a server, shorter than a person's patience with a dead service."""


class Offered(NamedTuple):
    """A service that is offered on the robot."""

    type: str
    rule: ServiceRule
    servers: tuple[NodeName, ...]
    """Those that a new request may go to."""


class Offers:
    """Services offered on the robot, and the servers behind each."""

    def __init__(self, rules: Rules, stats: EngineStats, *, budgeted: bool = False) -> None:
        """Take the rules; `budgeted` (budgets limit extra copies) is reported to the control plane."""
        self._rules = rules
        self._budgeted = budgeted
        self._stats = stats
        self._offered: dict[ServiceName, str] = {}
        self._shares = Shares(MAX_OFFERED_SERVICES)
        self._charged: dict[ServiceName, NodeName] = {}
        """Offered service -> the peer whose share it counts in: one of its servers when it was offered."""
        self._refused: set[ServiceName] = set()
        """Wanted services that had no room at the last look."""
        self._types: OrderedDict[ServiceName, str] = OrderedDict()
        """The type with which each service was last offered, in this run or an earlier one."""
        self._by_peer: dict[NodeName, tuple[dict[ServiceName, str], bool]] = {}
        """Peer -> (the type of each service that it offers, whether it drains)."""
        self._by_service: dict[ServiceName, dict[str, dict[NodeName, bool]]] = {}
        """Service -> type -> the peers that offer it with that type, and whether they drain."""
        self._touched: set[ServiceName] = set()
        """Services whose servers, or whose servers' types, have changed."""
        self._wanted: dict[ServiceName, tuple[str, tuple[NodeName, ...]]] = {}
        """Service -> (type, servers), as the peers offer it."""
        self._gained: set[ServiceName] = set()
        """Wanted services that got another server since the last `take_gained`."""
        self._dark_until: dict[ServiceName, float] = {}
        """Service without a server in reach -> when its offer ends."""
        self._conflicts: dict[ServiceName, set[tuple[ServiceName, NodeName, str]]] = {}

    @property
    def offered(self) -> dict[ServiceName, str]:
        """Return the names and types of the services offered now."""
        return self._offered

    @property
    def unreached(self) -> dict[ServiceName, int]:
        """Return the services that peers offer as the configuration wants them but that are not offered here because no
        path leads to any of those peers, each with the number of those peers."""
        self._choose_touched()
        return {
            name: len(servers)
            for name, (_, servers) in self._wanted.items()
            if name not in self._offered and name not in self._refused
        }

    @property
    def conflicts(self) -> set[tuple[ServiceName, NodeName, str]]:
        """Return the servers left out because their type differs from the configuration's or the other servers'."""
        self._choose_touched()
        return {conflict for of_service in self._conflicts.values() for conflict in of_service}

    def find(self, service: ServiceName) -> Offered | None:
        """Return a service if it is offered now."""
        kind, rule = self._offered.get(service), self._rules.find(service)
        return None if kind is None or rule is None else Offered(kind, rule, self.servers(service))

    def servers(self, service: ServiceName) -> tuple[NodeName, ...]:
        """Return the servers that a new request for this service may go to."""
        if service in self._touched:
            self._touched.discard(service)
            self._choose(service)
        wanted = self._wanted.get(service)
        return wanted[1] if wanted else ()

    def update(self, routes: Routes, now: float) -> list[OfferService | WithdrawService]:
        """Follow the peers' offers and the paths to them; return what changes on the robot."""
        self._choose_touched()
        reached = {name: kind for name, (kind, servers) in self._wanted.items() if routes.reaches_any(servers)}
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
        refused: set[ServiceName] = set()
        full: set[NodeName] = set()
        for name, kind in reached.items():
            self._dark_until.pop(name, None)
            if name in self._offered:
                continue
            if self._charge(name, full):
                self._offered[name] = kind
                self._note_type(name, kind)
                events.append(OfferService(name, kind))
            else:
                refused.add(name)
        if refused - self._refused:
            self._stats.dropped["too_many_offers"] += len(refused - self._refused)
        self._refused = refused
        return events

    def _charge(self, name: ServiceName, full: set[NodeName]) -> bool:
        """Count the service in the share of one of its servers that has room; `full` are those that had none.

        Servers take turns: finding the one with the smallest share would cost a look at each for each service.
        """
        servers = self._wanted[name][1]
        first = len(self._offered) % len(servers)
        for server in (*servers[first:], *servers[:first]):
            if server in full:
                continue
            if self._shares.fits(server):
                self._shares.take(server)
                self._charged[name] = server
                return True
            full.add(server)
        return False

    def _withdraw(self, name: ServiceName, reason: str) -> WithdrawService:
        del self._offered[name]
        self._shares.give_back(self._charged.pop(name))
        self._dark_until.pop(name, None)
        return WithdrawService(name, reason)

    def _patience_s(self, name: ServiceName) -> float:
        rule = self._rules.find(name)
        return max(WITHDRAW_AFTER_S, rule.lifetime_s) if rule else WITHDRAW_AFTER_S

    def uses(self, carried: Iterable[CarriedService]) -> tuple[ServiceUse, ...]:
        """Return those of these services that are offered, as reported to the control plane."""
        by_name = {service.name: service for service in carried}
        uses = []
        for name, kind in self._offered.items():
            rule = self._rules.find(name)
            if rule is not None and name in by_name:
                uses.append(
                    ServiceUse(
                        name,
                        kind,
                        rule.deadline_s,
                        rule.idempotent,
                        rule.copies,
                        rule.target_miss,
                        fallback_up=by_name[name].fallback_up,
                        redundancy=rule.redundancy,
                        hedge_quantile=rule.hedge_quantile,
                        budgeted=self._budgeted,
                        wanted_miss=rule.wanted_miss,
                    )
                )
        return tuple(uses)

    def knows_type(self, name: ServiceName) -> bool:
        """Return whether the service's last type is known."""
        return name in self._types

    def remember_type(self, name: ServiceName, kind: str) -> None:
        """Remember the type that an earlier run used."""
        if name not in self._types:
            self._note_type(name, kind)
            self._touched.add(name)

    def _note_type(self, name: ServiceName, kind: str) -> None:
        self._types[name] = kind
        self._types.move_to_end(name)
        if len(self._types) > MAX_TYPES:
            self._types.popitem(last=False)
            self._stats.dropped["type_forgotten"] += 1

    def set_peer(self, peer: Peer) -> None:
        """Take what a peer offers; `update` returns what changes."""
        offers = {offer.name: offer.type for offer in peer.offers if self._rules.find(offer.name) is not None}
        before, drained = self._by_peer.get(peer.name, ({}, False))
        if offers == before and drained == peer.draining:
            return
        self._by_peer[peer.name] = offers, peer.draining
        for name, kind in before.items():
            if offers.get(name) != kind:
                self._take_out(name, kind, peer.name)
        for name, kind in offers.items():
            if before.get(name) != kind or drained != peer.draining:
                self._by_service.setdefault(name, {}).setdefault(kind, {})[peer.name] = peer.draining
                self._touched.add(name)

    def others(self, peers: Container[NodeName]) -> list[NodeName]:
        """Return the peers known here that are not among these."""
        return [name for name in self._by_peer if name not in peers]

    def forget_peer(self, peer: NodeName) -> None:
        """Forget a peer that is gone."""
        offers, _ = self._by_peer.pop(peer, ({}, False))
        for name, kind in offers.items():
            self._take_out(name, kind, peer)

    def _take_out(self, name: ServiceName, kind: str, peer: NodeName) -> None:
        by_type = self._by_service[name]
        del by_type[kind][peer]
        if not by_type[kind]:
            del by_type[kind]
        if not by_type:
            del self._by_service[name]
        self._touched.add(name)

    def _choose_touched(self) -> None:
        while self._touched:
            self._choose(self._touched.pop())

    def _choose(self, name: ServiceName) -> None:
        """Settle the service's type and servers; draining servers count only if there is no other."""
        by_type = self._by_service.get(name)
        before = self._wanted.pop(name, None)
        self._conflicts.pop(name, None)
        if by_type is None:
            self._gained.discard(name)
            return
        rule = self._rules.find(name)
        kind = rule.type if rule is not None else ""
        if not kind:
            last = self._types.get(name)
            # The type with most servers wins. The last type wins a tie, so that one odd server changes nothing.
            kind = max(sorted(by_type), key=lambda kind: (len(by_type[kind]), kind == last))
        odd = {(name, peer, other) for other, peers in by_type.items() if other != kind for peer in peers}
        if odd:
            self._conflicts[name] = odd
        if kind not in by_type:
            self._gained.discard(name)
            return
        fresh = [peer for peer, drains in by_type[kind].items() if not drains]
        servers = tuple(fresh or by_type[kind])
        self._wanted[name] = kind, servers
        if before is None or not set(servers) <= set(before[1]):
            self._gained.add(name)

    def take_gained(self) -> set[ServiceName]:
        """Return the services that got another server since the last call."""
        self._choose_touched()
        gained, self._gained = self._gained, set()
        return gained

    def next_timer(self) -> float | None:
        """Return when the first darkness ends an offer."""
        return min(self._dark_until.values(), default=None)
