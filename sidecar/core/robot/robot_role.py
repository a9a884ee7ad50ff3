"""Robot's role: sends the application's requests to the servers that peers offer, and reports what that showed."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

from plr.sidecar.core.base.report_scope import ReportScope
from plr.sidecar.core.base.slices import rest
from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.robot.dispatch.context import RequestParts
from plr.sidecar.core.robot.dispatch.penalties import Penalties
from plr.sidecar.core.robot.goodbyes import Goodbyes
from plr.sidecar.core.robot.measure.measurements import Measurements
from plr.sidecar.core.robot.request.mapping_table import MappingTable
from plr.sidecar.core.robot.request.service_catalog import Offers
from plr.sidecar.core.robot.request_table import RequestTable
from plr.sidecar.core.seam.application import OfferService, WithdrawService
from plr.sidecar.core.seam.links import Seek
from plr.sidecar.core.wire.messages import RejectionMessage, RequestMessage, ResponseMessage

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping

    from plr.protos.model.ids import InterfaceName, NodeName, ServiceName, SessionId
    from plr.protos.model.mapping import MappingSet, ServiceMapping
    from plr.protos.model.members import ServiceOffer, ServiceUse
    from plr.protos.model.report import Report
    from plr.sidecar.core.base.slices import Step
    from plr.sidecar.core.base.values import PathId
    from plr.sidecar.core.message.outbound import OutboundMessage
    from plr.sidecar.core.rules.budget import Budget
    from plr.sidecar.core.seam.application import CarriedService
    from plr.sidecar.core.seam.links import PathMeasured
    from plr.sidecar.core.transfer.engine_parts import EngineParts
    from plr.sidecar.core.wire.messages import ServiceMessage


class Destinations(NamedTuple):
    """Where the requests of a robot may go."""

    services: Mapping[ServiceName, tuple[tuple[NodeName, ...], bool]]
    """Service offered here -> (its servers, whether its requests are idempotent)."""
    out_of_favour: frozenset[NodeName]
    """Servers that get requests only if there are no others."""
    conflicts: frozenset[tuple[ServiceName, NodeName, str]]
    """(service, server, type) of the servers that get no requests, because of their type."""


class RobotRole:
    """The requests, the services offered on the robot, the mapping, and the measurements."""

    def __init__(self, parts: EngineParts, budgets: tuple[Budget, ...]) -> None:
        self._parts = parts
        self._carried: frozenset[CarriedService] = frozenset()
        self._services_changed = False
        self._measurements = Measurements(parts.stats.dropped)
        self._penalties = Penalties()
        self._goodbyes = Goodbyes()
        self.catalog = Offers(parts.rules, parts.stats, budgeted=any(one.limits for one in budgets))
        self.mapping = MappingTable(parts.routes)
        self.requests = RequestTable(
            RequestParts(
                self.catalog,
                self.mapping,
                parts.routes,
                parts.outbox,
                self._measurements,
                parts.stats,
                parts.emit,
                parts.command,
                budgets,
                parts.backlog,
                penalties=self._penalties,
            )
        )

    # -- the application and the program --------------------------------------------------------------------------

    def set_carried(self, services: frozenset[CarriedService]) -> None:
        """Replace the proxied services that exist right now."""
        self._carried = services
        self._services_changed = True

    def drain(self) -> None:
        """Do nothing: no peer sends requests to a robot."""

    def awaited(self, _peers: Collection[NodeName]) -> int:
        """Return the number of requests that the application waits for."""
        return self.requests.unanswered

    # -- the control plane ----------------------------------------------------------------------------------------

    def offers(self) -> tuple[ServiceOffer, ...]:
        """Return nothing: a robot runs no requests."""
        return ()

    def uses(self) -> tuple[ServiceUse, ...]:
        """Return the services that this robot carries."""
        return self.catalog.uses(self._carried)

    def take_services_changed(self) -> bool:
        """Return whether `uses` may have changed since the last call."""
        changed, self._services_changed = self._services_changed, False
        return changed

    @property
    def offer_conflicts(self) -> frozenset[tuple[ServiceName, NodeName, str]]:
        """Return the servers left out as (service, server, type): the configuration or the others differ."""
        return frozenset(self.catalog.conflicts)

    def apply_mapping(self, mapping: MappingSet, interfaces: Collection[InterfaceName]) -> str | None:
        """Take a mapping; return why it is refused, or None."""
        error = self.mapping.apply(mapping, interfaces, self._parts.peers.names())
        if error is None:
            self._parts.stats.mapping_version = self.mapping.version
            self._remember_types(mapping)
        return error

    def _remember_types(self, mapping: MappingSet) -> None:
        """Remember each mapped service's type, which its mapped servers offer. After a restart that is all we know, and
        a server that offers another type must not win by coming first."""
        for service in mapping.services:
            if self.catalog.knows_type(service.service):
                continue
            servers = {assignment.server for assignment in service.assignments}
            peers = [self._parts.peers.get(server) for server in servers]
            kinds = {offer.type for peer in peers if peer for offer in peer.offers if offer.name == service.service}
            if len(kinds) == 1:
                self.catalog.remember_type(service.service, kinds.pop())

    @property
    def service_mappings(self) -> tuple[ServiceMapping, ...]:
        """Return the mapping in force."""
        return tuple(self.mapping.services.values())

    def destinations(self, now: float) -> Destinations:
        """Return where new requests may go: what `MappingTable.choose` needs, besides the paths and the mapping."""
        offered = {name: self.catalog.find(name) for name in self.catalog.offered}
        return Destinations(
            {name: (one.servers, one.rule.idempotent) for name, one in offered.items() if one is not None},
            frozenset(one.server for one in self._penalties.report(now)),
            frozenset(self.catalog.conflicts),
        )

    def take_urgency(self) -> ReportScope | None:
        """Return what to report before the next report, since a path changed or a deadline was missed."""
        return self._measurements.take_urgency()

    def take_report(self, now: float, scope: ReportScope) -> Report:
        """Return what was measured since the last report."""
        if scope is ReportScope.CHANGES:
            measured = self._measurements.take_changes(self._parts.routes)
        else:
            measured = self._measurements.take(self._parts.routes, self._parts.peers.names())
        return replace(measured, penalties=self._penalties.report(now), goodbyes=self._goodbyes.report())

    # -- the servers ----------------------------------------------------------------------------------------------

    def on_message(
        self, path: PathId, message: ServiceMessage, _ends_at: float, now: float, *, beside: tuple[PathId, ...] = ()
    ) -> None:
        """Take a server's message."""
        if isinstance(message, ResponseMessage):
            self.requests.on_response(path.peer, message, now)
        elif isinstance(message, RejectionMessage):
            self.requests.on_rejection(path.peer, message, now)
        else:
            kind = "request" if isinstance(message, RequestMessage) else "cancel"
            self._parts.stats.dropped[f"{kind}_to_a_robot"] += 1

    def on_room(self, now: float) -> None:
        """Send what waits for room, since less is under way than before."""
        self.requests.on_room(now)

    def on_peers_changed(self, now: float) -> None:
        """Follow the peers' offers, as the peers or their services may have changed."""
        self._parts.backlog.add(self._take_offers, now, "offers")

    def _take_offers(self) -> Iterator[Step]:
        peers = self._parts.peers
        for name in (*peers.names(), *self.catalog.others(peers)):
            yield partial(self._take_offers_of, name)
            yield from _REST  # a peer may offer hundreds of services
        yield self.on_reach_changed

    def _take_offers_of(self, name: NodeName, _now: float) -> None:
        peer = self._parts.peers.get(name)
        if peer is not None:
            self.catalog.set_peer(peer)
        else:
            self.catalog.forget_peer(name)

    def on_reach_changed(self, now: float) -> None:
        """Offer on the robot what servers within reach offer."""
        for event in self.catalog.update(self._parts.routes, now):
            steps: list[Step] = []
            if isinstance(event, WithdrawService):
                steps += self.requests.withdraw(event.name, event.reason)
            steps.append(partial(self._tell, event))  # requests that wait at a service end before the service does
            self._parts.backlog.add(steps.copy, now)
        gained = self.catalog.take_gained()
        if gained:
            self.requests.on_servers_gained(gained, now)

    def _tell(self, event: OfferService | WithdrawService, _now: float) -> None:
        self._parts.emit(event)
        self._services_changed = True  # a service in use is carried and offered

    def on_view(self, _gone: Collection[NodeName], _now: float) -> None:
        """Follow which servers that said goodbye the view still lists."""
        self._goodbyes.follow(self._parts.peers.session)

    def on_closed(self, peer: NodeName, session: SessionId, now: float) -> None:
        """Send nothing more to a server that said goodbye, and report the goodbye."""
        self._goodbyes.note(peer, session)
        self._parts.backlog.add_steps(self._parts.outbox.drop_peer(peer), now)

    def on_session_over(self, peer: NodeName, now: float, may_return: SessionId | None) -> None:
        """Drop what was meant for a server whose session is over: nobody answers it. A dormant server may."""
        if may_return is not None and self._parts.peers.is_dormant(peer):
            self.requests.on_peer_dormant(peer, now)
            return
        self._parts.backlog.add_steps(self._parts.outbox.drop_peer(peer), now)

    def on_peer_back(self, _peer: NodeName, now: float) -> None:
        """Offer what the server offers again."""
        self.on_peers_changed(now)

    def on_peer_gone(self, peer: NodeName, now: float) -> None:
        """End the copies at a server whose session ended."""
        self.requests.on_peer_gone(peer, now)

    # -- the paths ------------------------------------------------------------------------------------------------

    def on_path_changed(self, path: PathId, state: PathState, now: float) -> None:
        """Report that a path went up or down, and move requests that it concerns."""
        self._measurements.note_path_change(path)
        if state is PathState.UP:
            self._goodbyes.is_back(path.peer)
            if self.requests.unanswered:  # the other paths may be back as well, and share what waits
                self._parts.command(Seek(frozenset((path.peer,))))
        self.requests.on_path_changed(path, state, now)

    def on_path_gone(self, path: PathId, now: float) -> None:
        """Move the requests off a path whose interface is gone."""
        self.requests.on_path_changed(path, PathState.DOWN, now)

    def on_path_measured(self, event: PathMeasured) -> None:
        """Note a link's measurement of a path for the next report."""
        self._measurements.path(event)

    def on_copy_lost(self, message: OutboundMessage, now: float) -> None:
        """Send the backup now if nothing is heard of the copy that has one."""
        self.requests.on_copy_lost(message, now)

    # -- time -----------------------------------------------------------------------------------------------------

    def next_timer(self) -> float | None:
        """Return when to call `handle_timer`."""
        timers = (self.requests.next_timer(), self.catalog.next_timer())
        return min((timer for timer in timers if timer is not None), default=None)

    def on_woken(self, slept_s: float, now: float) -> None:
        """End the requests whose lifetime ended while the host was suspended."""
        self.requests.on_woken(slept_s, now)

    def handle_timer(self, now: float) -> None:
        """Handle the requests' deadlines that are over, and end the offers that were dark for long."""
        self.requests.handle_timer(now)
        dark_until = self.catalog.next_timer()
        if dark_until is not None and dark_until <= now:
            self.on_reach_changed(now)


_REST: tuple[Step, ...] = (rest,) * 5
