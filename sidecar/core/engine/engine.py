"""Holds the sidecar's requests, peers and routes, which all links share. Sans-IO; the caller serialises the calls.

Inputs are method calls with `now`; outputs are `take_commands` (for the links) and `take_events` (for the
application). Nothing here builds, seals or parses a datagram.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

from plr.protos.base.errors import DecodeError, UnknownKindError
from plr.protos.model.ids import Role
from plr.protos.model.members import MAX_PEERS, PeerSet, RemovalReason, ServiceUse
from plr.sidecar.core.base.report_scope import ReportScope
from plr.sidecar.core.base.slices import SLICE, Backlog, Step, rest
from plr.sidecar.core.base.values import ExecutionId, PathId, PathState, RejectReason, RequestId
from plr.sidecar.core.cloud.serving import Serving, ServingParts
from plr.sidecar.core.engine.attention import Attention
from plr.sidecar.core.engine.peers import Peers
from plr.sidecar.core.engine.revocation_exchange import RevocationExchange
from plr.sidecar.core.robot.dispatch.context import RequestParts
from plr.sidecar.core.robot.dispatch.penalties import Penalties
from plr.sidecar.core.robot.goodbyes import Goodbyes
from plr.sidecar.core.robot.measure.measurements import Measurements
from plr.sidecar.core.robot.request.mapping_table import MappingTable
from plr.sidecar.core.robot.request.service_catalog import Offers
from plr.sidecar.core.robot.request_table import RequestTable
from plr.sidecar.core.rules.service_rule import Rules, ServiceRule
from plr.sidecar.core.seam.application import ApplicationEvent, CarriedService, OfferService, WithdrawService
from plr.sidecar.core.seam.links import (
    Attend,
    FinishedLost,
    FragmentsLost,
    FragmentsReceived,
    LinkCommand,
    LinkEvent,
    MessageAbandoned,
    MessageFinished,
    MessageForgotten,
    PathChanged,
    PathCommand,
    PathMeasured,
    PathMtuChanged,
    PeerClosed,
    PeerLied,
    PeerRenewed,
    PeerRestarted,
    Seek,
    SetPeers,
)
from plr.sidecar.core.seam.stats import EngineStats
from plr.sidecar.core.transfer.inbound import Inbound
from plr.sidecar.core.transfer.outbox import Outbox
from plr.sidecar.core.transfer.routes import Routes
from plr.sidecar.core.wire.messages import (
    CancelMessage,
    RequestMessage,
    ResponseMessage,
    RevocationLists,
    RevocationsHeld,
    RevocationsWanted,
    decode_message,
)

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator

    from plr.protos.model.ids import InterfaceName, NodeName, ServiceName, SessionId
    from plr.protos.model.mapping import MappingSet, ServiceMapping
    from plr.protos.model.members import Peer, ServiceOffer
    from plr.protos.model.report import Report
    from plr.sidecar.core.crypto.session import OwnSession
    from plr.sidecar.core.message.decoding import Decoding
    from plr.sidecar.core.rules.budget import Budget

SWEEP_EVERY_S = 1.0
"""Interval of the search for old messages and partial messages."""


@dataclass(frozen=True, slots=True)
class EngineConfig:
    """The part of the configuration that the engine needs."""

    role: Role
    rules: tuple[ServiceRule, ...]
    budgets: tuple[Budget, ...] = ()
    """Robot: budgets, of which the first that matches an interface's name decides."""


class Engine:
    """One sidecar without its sockets, its clock and ROS."""

    def __init__(self, config: EngineConfig, own: OwnSession, now: float) -> None:
        self._config = config
        self._rules = Rules(config.rules)
        self._backlog = Backlog()
        self.stats = EngineStats()
        self._commands: list[tuple[InterfaceName | None, LinkCommand]] = []
        self._events: list[ApplicationEvent] = []
        self._interfaces: set[InterfaceName] = set()
        self._away: dict[NodeName, SessionId] = {}
        """Cloud: robots that fell silent, are no peers any more, and may come back with this session."""
        self._carried: frozenset[CarriedService] = frozenset()
        self._services_changed = False
        """Whether `offers` or `uses` may have changed since the last `take_services_changed`."""
        self._sweep_at = now + SWEEP_EVERY_S
        self._attention = Attention(now)
        self._inbound = Inbound(self._to_link, self.stats, answers=config.role is Role.CLOUD)
        self.peers = Peers(own, self.stats.dropped)
        self.routes = Routes()
        self.mapping = MappingTable(self.routes)
        self._offers = Offers(self._rules, self.stats, budgeted=any(one.limits for one in config.budgets))
        self._outbox = Outbox(self.routes, self._to_link, self.stats)
        self.revocations = RevocationExchange(self.routes, self._outbox, self.stats)
        self._measurements = Measurements(self.stats.dropped)
        self._penalties = Penalties()
        self._goodbyes = Goodbyes()
        self._serving = Serving(
            ServingParts(
                self._rules,
                self.routes,
                self._outbox,
                self.stats,
                self._events.append,
                self.peers.may_call,
                self._backlog,
            )
        )
        self._requests = RequestTable(
            RequestParts(
                self._offers,
                self.mapping,
                self.routes,
                self._outbox,
                self._measurements,
                self.stats,
                self._events.append,
                self._seek,
                config.budgets,
                self._backlog,
                penalties=self._penalties,
            )
        )

    # -- outputs --------------------------------------------------------------------------------------------------

    def take_commands(self) -> list[tuple[InterfaceName | None, LinkCommand]]:
        """Return the commands for the links; None as interface means all of them."""
        commands, self._commands = self._commands, []
        return commands

    def take_events(self) -> list[ApplicationEvent]:
        """Return the events for the application."""
        events = self._events[:]
        self._events.clear()
        return events

    def next_decoding(self) -> Decoding | None:
        """Return the message whose next slice is to be computed, outside any lock."""
        return self._inbound.next_decoding()

    @property
    def decodings(self) -> int:
        """Return the number of messages to decode."""
        return self._inbound.decodings

    def _to_link(self, command: PathCommand) -> None:
        self._commands.append((command.path.interface, command))

    def _seek(self, peers: frozenset[NodeName]) -> None:
        self._commands.append((None, Seek(peers)))

    # -- the application's calls ----------------------------------------------------------------------------------

    def submit(self, request_id: RequestId, service: ServiceName, payload: bytes, now: float) -> None:
        """Robot: send a serialised request."""
        rule = self._rules.find(service)
        kind = self._offers.offered.get(service)
        if rule is None or kind is None:
            self._requests.reject(request_id, service, "no server offers this service any more")
            return
        servers = frozenset(self._offers.servers(service))
        if self._attention.needs(servers, now):
            self._commands.append((None, Attend(servers)))
        self._requests.submit(request_id, service, kind, rule, payload, now)
        self._count_in_flight()

    def judge_answer(self, request_id: RequestId, copy: int, problem: str | None, now: float) -> None:
        """Robot: note that this copy's answer was delivered to the application, or cannot be because of `problem`."""
        self._requests.judge_answer(request_id, copy, problem, now)
        self._count_in_flight()

    def answered_locally(self, request_id: RequestId, now: float) -> None:
        """Robot: note that the application got its answer on the robot."""
        self._requests.answered_locally(request_id, now)
        self._count_in_flight()

    def complete(self, execution: ExecutionId, payload: bytes, processing_s: float, now: float) -> None:
        """Cloud: send the local server's answer."""
        self._serving.complete(execution, payload, processing_s, now)
        self._count_in_flight()

    def refuse(self, execution: ExecutionId, reason: RejectReason, detail: str, now: float) -> None:
        """Cloud: refuse a request that was not or will not be answered."""
        self._serving.refuse(execution, reason, detail, now)
        self._count_in_flight()

    def set_offers(self, offers: Iterable[ServiceOffer]) -> None:
        """Cloud: replace the services that local servers offer right now."""
        self._serving.set_offers(offers)
        self._services_changed = True

    def set_carried(self, services: frozenset[CarriedService]) -> None:
        """Robot: replace the proxied services that exist right now."""
        self._carried = services
        self._services_changed = True

    def drain(self) -> None:
        """Cloud: take no new requests; those in flight go on."""
        self._serving.drain()

    @property
    def busy(self) -> int:
        """Return the number of requests and messages in flight that somebody still waits for: reasons not to exit."""
        peers = frozenset(self.peers.names())
        messages = sum(self._outbox.messages_to(peer) for peer in peers)
        return self._serving.awaited(peers) + self._requests.unanswered + messages

    # -- the control plane ----------------------------------------------------------------------------------------

    def offers(self) -> tuple[ServiceOffer, ...]:
        """Return the services that this sidecar can run."""
        return self._serving.offers

    def uses(self) -> tuple[ServiceUse, ...]:
        """Return the services that this sidecar carries."""
        return self._offers.uses(self._carried)

    def take_services_changed(self) -> bool:
        """Return whether `offers` or `uses` may have changed since the last call."""
        changed, self._services_changed = self._services_changed, False
        return changed

    def set_interfaces(self, interfaces: Iterable[InterfaceName], now: float) -> None:
        """Replace the interfaces that have a link now."""
        new = set(interfaces)
        gone = self._interfaces - new
        self._interfaces = new
        for interface in gone:
            paths = self.routes.forget_interface(interface)
            self._backlog.add_steps(self._outbox.on_interface_gone(interface), now)
            for path in paths:
                self._requests.on_path_changed(path, PathState.DOWN, now)
            dark = dict.fromkeys(path.peer for path in paths if not self.routes.reaches(path.peer))
            self._drop_unlisted(dark, now)
        self._update_offers(now)
        self._commands.append((None, SetPeers(self.peers.for_links())))

    def apply_peers(self, peer_set: PeerSet, now: float) -> str | None:
        """Take a view of the peers; return why it is refused, or None."""
        before = {peer.name: peer.session for peer in self.peers.all()}
        left = {removed.name for removed in peer_set.removed if removed.reason is not RemovalReason.LEASE_EXPIRED}
        error = self.peers.apply(peer_set, self.routes.reaches)
        if error:
            self.stats.nacks += 1
            return error
        self.stats.peers_version = self.peers.version
        self._commands.append((None, SetPeers(self.peers.for_links())))
        self._follow_offers(now)
        ended = [name for name, session in before.items() if self.peers.session(name) != session]
        for name in ended:
            over = name in self.peers or name in left or name in self.peers.refused
            self._forget_session(name, now, may_return=None if over else before[name])
        self._follow_gone(ended, now)
        self._end_away(left, now)
        self._goodbyes.follow(self.peers.session)
        return None

    def _end_away(self, left: Collection[NodeName], now: float) -> None:
        """Forget the peers that might have come back: some have, and others never will."""
        for name, session in list(self._away.items()):
            if self.peers.session(name) == session:
                del self._away[name]
            elif name in self.peers or name in left or name in self.peers.refused:
                self._forget_session(name, now)

    def _follow_offers(self, now: float) -> None:
        """Follow the peers' offers, as the peers or their services may have changed."""
        if self._config.role is Role.ROBOT:
            self._backlog.add(self._take_offers, now, "offers")

    def _take_offers(self) -> Iterator[Step]:
        for name in (*self.peers.names(), *self._offers.others(self.peers)):
            yield partial(self._take_offers_of, name)
            yield from _REST  # a peer may offer hundreds of services
        yield self._update_offers

    def _take_offers_of(self, name: NodeName, _now: float) -> None:
        peer = self.peers.get(name)
        if peer is not None:
            self._offers.set_peer(peer)
        else:
            self._offers.forget_peer(name)

    def services_of_peers(self) -> set[ServiceName]:
        """Return the services that the peers offer, whatever their names."""
        peers = map(self.peers.get, self.peers.names())
        return {offer.name for peer in peers if peer is not None for offer in peer.offers}

    def unreached_services(self) -> dict[ServiceName, int]:
        """Return the services for which no offering peer is reached, each with the number of those peers."""
        return self._offers.unreached

    def recheck_peers(self, judged: Iterable[Peer], now: float) -> list[NodeName]:
        """End the sessions of peers that are bad now; return the refused ones taken, as they are `judged` good."""
        gone, taken = self.peers.recheck(), self.peers.readmit(judged)
        self._commands.append((None, SetPeers(self.peers.for_links())))
        self._follow_offers(now)
        for name in gone:
            self._forget_session(name, now)
        self._follow_gone(gone, now)
        return taken

    def apply_mapping(self, mapping: MappingSet) -> str | None:
        """Take a mapping; return why it is refused, or None."""
        error = self.mapping.apply(mapping, self._interfaces, self.peers.names())
        if error:
            self.stats.nacks += 1
            return error
        self.stats.mapping_version = self.mapping.version
        if self._config.role is Role.ROBOT:
            self._remember_types(mapping)
        return None

    def _remember_types(self, mapping: MappingSet) -> None:
        """Remember each mapped service's type, which its mapped servers offer. After a restart that is all we know, and
        a server that offers another type must not win by coming first."""
        for service in mapping.services:
            if self._offers.knows_type(service.service):
                continue
            peers = [self.peers.get(server) for server in {assignment.server for assignment in service.assignments}]
            kinds = {offer.type for peer in peers if peer for offer in peer.offers if offer.name == service.service}
            if len(kinds) == 1:
                self._offers.remember_type(service.service, kinds.pop())

    @property
    def offer_conflicts(self) -> frozenset[tuple[ServiceName, NodeName, str]]:
        """Robot: return the servers left out as (service, server, type): the configuration or the others differ."""
        return frozenset(self._offers.conflicts)

    def take_urgency(self) -> ReportScope | None:
        """Robot: return what to report before the next report, since a path changed or a deadline was missed."""
        return self._measurements.take_urgency() if self._config.role is Role.ROBOT else None

    def take_report(self, now: float, scope: ReportScope = ReportScope.ALL) -> Report:
        """Return what was measured since the last report."""
        if scope is ReportScope.CHANGES:
            measured = self._measurements.take_changes(self.routes)
        else:
            measured = self._measurements.take(self.routes, self.peers.names())
        return replace(measured, penalties=self._penalties.report(now), goodbyes=self._goodbyes.report())

    @property
    def service_mappings(self) -> tuple[ServiceMapping, ...]:
        """Return the mapping in force."""
        return tuple(self.mapping.services.values())

    # -- the links' events ----------------------------------------------------------------------------------------

    def on_link_event(self, event: LinkEvent, now: float) -> None:
        """Take an event of a link."""
        match event:
            case FragmentsReceived(path, session, fragments):
                if self._is_current(path, session):
                    for content, ends_at in self._inbound.add(path, session, fragments, now):
                        self._on_message(path, content, ends_at, now)
            case MessageAbandoned(peer, session, number):
                if self.peers.session(peer) == session:
                    self._inbound.abandon(peer, number)
            case MessageForgotten(peer, number):
                self._outbox.on_forgotten(peer, number)
            case MessageFinished(peer, number):
                self._outbox.on_finished(peer, number)
            case FinishedLost(path, numbers) if path.peer in self.peers:
                self._inbound.on_finished_lost(path.peer, numbers, self.routes.best_to(path.peer))
            case FragmentsLost():
                if event.timed_out and not event.message.over:
                    self._requests.on_copy_lost(event.message, now)
                self._outbox.on_lost(event, now)
            case PathMeasured() if self._knows(event.path):
                self.routes.set_rtt(event.path, event.smoothed_rtt_s)
                self.routes.note_fates(event.path, event.arrived, event.missed, policed=event.policed)
                self._measurements.path(event)
            case PathChanged():
                self._on_path_changed(event, now)
            case PathMtuChanged(path, max_datagram) if self._knows(path):
                self.routes.set_max_datagram(path, max_datagram)
            case FinishedLost() | PathMeasured() | PathMtuChanged():
                pass  # of a peer that has just left, or an interface that has just gone
            case PeerRestarted():
                if self.peers.restarted(event, now):
                    self._forget_session(event.peer, now)
                    self._follow_gone((event.peer,), now)
                    self._commands.append((None, SetPeers(self.peers.for_links())))
            case PeerRenewed():
                if self.peers.renewed(event, now):
                    self._commands.append((None, SetPeers(self.peers.for_links())))
            case PeerClosed(peer, session):
                if self.peers.session(peer) == session:
                    if self._config.role is Role.ROBOT:
                        self._goodbyes.note(peer, session)
                    self._on_peer_closed(peer, now)
            case PeerLied(peer, session):
                if self.peers.session(peer) == session:
                    self.peers.condemn(session)
                    self.recheck_peers((), now)
        self._after_news(now)

    def on_decoded(self, decoding: Decoding, now: float) -> None:
        """Take a message whose decoding is complete (`decoding.run_slice` says when)."""
        arrived = self._inbound.take_decoded(decoding)
        if arrived is not None:
            self._on_message(decoding.path, *arrived, now)
            self._after_news(now)

    def on_decoding_failed(self, decoding: Decoding) -> None:
        """Give up a message that cannot be decoded."""
        self._inbound.forgo_decoding(decoding)

    def _after_news(self, now: float) -> None:
        if self._outbox.take_made_room():
            self._use_room(now)
        self._count_in_flight()

    def _count_in_flight(self) -> None:
        self.stats.in_flight = self._requests.unanswered + self._serving.running

    def _use_room(self, now: float) -> None:
        """Send what waits for room, since less is under way than before."""
        self._requests.on_room(now)
        self._serving.on_room(now)
        self.revocations.on_room(now)

    def _is_current(self, path: PathId, session: SessionId) -> bool:
        if self.peers.session(path.peer) == session:
            return True
        self.stats.dropped["fragment_of_old_session"] += 1
        return False

    def _on_message(self, path: PathId, content: memoryview, ends_at: float, now: float) -> None:
        try:
            message = decode_message(content)
        except UnknownKindError:
            self.stats.dropped["unknown_message"] += 1
            return
        except DecodeError:
            self.stats.dropped["malformed_message"] += 1
            return
        robot = self._config.role is Role.ROBOT
        if isinstance(message, RevocationsHeld | RevocationsWanted | RevocationLists):
            self.revocations.on_message(path.peer, message, now)
        elif isinstance(message, RequestMessage):
            if robot:
                self.stats.dropped["request_to_a_robot"] += 1
            else:
                self._serving.on_request(path, message.when_left(ends_at - now), now)
        elif isinstance(message, CancelMessage):
            if robot:
                self.stats.dropped["cancel_to_a_robot"] += 1
            else:
                self._serving.on_cancel(path.peer, message, now)
        elif not robot:
            self.stats.dropped["response_to_a_cloud"] += 1
        elif isinstance(message, ResponseMessage):
            self._requests.on_response(path.peer, message, now)
        else:
            self._requests.on_rejection(path.peer, message, now)

    def _on_path_changed(self, event: PathChanged, now: float) -> None:
        path, state = event.path, event.state
        if not self._knows(path) or self.routes.state(path) is state:
            return
        reached = self.routes.reaches(path.peer)
        self.routes.set_state(path, state)
        self._measurements.note_path_change(path)
        if state is PathState.UP:
            self._goodbyes.is_back(path.peer)
            self._backlog.add_steps(self._outbox.on_path_up(path), now)
            self._inbound.on_path_up(path)
            if self._requests.unanswered:  # the other paths may be back as well, and share what waits
                self._seek(frozenset((path.peer,)))
        elif state is PathState.DOWN and not self.routes.reaches(path.peer):
            self._drop_unlisted((path.peer,), now)
        if self.routes.reaches(path.peer) is not reached:
            self._update_offers(now)
            if not reached:
                self.revocations.on_reached(path.peer, now)
        self._requests.on_path_changed(path, state, now)

    def _knows(self, path: PathId) -> bool:
        return path.peer in self.peers and path.interface in self._interfaces

    def _drop_unlisted(self, dark: Iterable[NodeName], now: float) -> None:
        """Drop those of these peers, whose last path died, that were kept for their paths only."""
        dropped: dict[NodeName, SessionId | None] = {}
        for name in dark:
            session = self.peers.session(name)
            if self.peers.drop_if_unlisted(name):
                dropped[name] = session
        if not dropped:
            return
        self._follow_offers(now)
        for name, session in dropped.items():
            self._forget_session(name, now, may_return=session)
        self._follow_gone(dropped, now)
        self._commands.append((None, SetPeers(self.peers.for_links())))

    def _on_peer_closed(self, name: NodeName, now: float) -> None:
        """Send nothing new to a peer that said goodbye; the control plane will remove it as well."""
        for route in self.routes.all_to(name):
            self.routes.set_state(route.id, PathState.DOWN)
        self._backlog.add_steps(
            [
                *self._outbox.drop_peer(name),
                *self._serving.on_session_over(name),
                *self._serving.on_robot_gone(name),
            ],
            now,
        )
        self._update_offers(now)
        self._requests.on_peer_gone(name, now)
        self._drop_unlisted((name,), now)

    def _forget_session(self, name: NodeName, now: float, *, may_return: SessionId | None = None) -> None:
        """End a peer's session; with `may_return` it only fell silent, and may come back with it for its answers."""
        if may_return is not None and self._config.role is Role.CLOUD:
            self._away[name] = may_return
            if len(self._away) > MAX_PEERS:
                self._forget_session(next(iter(self._away)), now)
        else:
            self._away.pop(name, None)
            called_off = self._serving.on_session_over(name)
            let_go = [*self._outbox.drop_peer(name), *self._serving.on_robot_gone(name)]
            self._backlog.add_steps(called_off + let_go, now)
        self._inbound.forget_peer(name)
        self.revocations.forget_peer(name)
        self.routes.forget_peer(name)

    def _follow_gone(self, names: Collection[NodeName], now: float) -> None:
        if names:
            self._update_offers(now)
        for name in names:
            self._requests.on_peer_gone(name, now)

    def _update_offers(self, now: float) -> None:
        if self._config.role is Role.ROBOT:
            for event in self._offers.update(self.routes, now):
                steps: list[Step] = []
                if isinstance(event, WithdrawService):
                    steps += self._requests.withdraw(event.name, event.reason)
                steps.append(partial(self._tell, event))  # requests that wait at a service end before the service does
                self._backlog.add(steps.copy, now)
            gained = self._offers.take_gained()
            if gained:
                self._requests.on_servers_gained(gained, now)

    def _tell(self, event: OfferService | WithdrawService, _now: float) -> None:
        self._events.append(event)
        self._services_changed = True  # a service in use is carried and offered

    # -- time -----------------------------------------------------------------------------------------------------

    def next_timer(self) -> float:
        """Return when to call `handle_timer` next."""
        timers = (
            self._backlog.next_timer(),
            self._requests.next_timer(),
            self._serving.next_timer(),
            self._offers.next_timer(),
        )
        return min((self._sweep_at, self.revocations.next_timer(), *(timer for timer in timers if timer is not None)))

    def handle_timer(self, now: float) -> None:
        """Do what is due now, as much of it as one turn has room for."""
        self._backlog.begin_turn(now)
        self._backlog.run(now, leave=SLICE // 2)  # deadlines must not wait until all is done
        self._requests.handle_timer(now)
        self._serving.handle_timer(now)
        self.revocations.handle_timer(now)
        self._backlog.run(now)
        if now >= self._sweep_at:
            self._sweep_at = now + SWEEP_EVERY_S
            self._backlog.add_steps(self._outbox.expired(now), now)
            self._outbox.ask_again()
            self._inbound.expire(now)
        dark_until = self._offers.next_timer()
        if dark_until is not None and dark_until <= now:
            self._update_offers(now)
        if self._outbox.take_made_room():
            self._use_room(now)
        self._count_in_flight()


_REST: tuple[Step, ...] = (rest,) * 5
