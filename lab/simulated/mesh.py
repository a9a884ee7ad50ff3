"""A mesh of real cores in simulated time: engines and links joined by a lossy, reordering, duplicating network."""

from __future__ import annotations

import heapq
import random
from dataclasses import dataclass, field, replace
from itertools import count
from typing import TYPE_CHECKING

from lab.simulated.sessions import session_of
from plr.protos.model.ids import InterfaceId, InterfaceName, NodeName, Role, ServiceName, SessionId, Version
from plr.protos.model.members import ALL_CALLS, Candidate, CandidateKind, Peer, PeerSet, ServiceOffer
from plr.protos.trust.credential import Aead
from plr.protos.trust.pair_token import pair_token
from plr.sidecar.control.announcement import Announcer
from plr.sidecar.core.base.request_id import make_request_id
from plr.sidecar.core.base.values import RequestId
from plr.sidecar.core.engine.engine import Engine, EngineConfig
from plr.sidecar.core.link.link import Link
from plr.sidecar.core.link.sender import LinkIdentity
from plr.sidecar.core.path.congestion.choice import DEFAULT_CONTROLLER
from plr.sidecar.core.path.key_exchange import DEFAULT_LIMITS
from plr.sidecar.core.path.pmtu import HEADERS_V4
from plr.sidecar.core.rules.service_rule import ServiceRule
from plr.sidecar.core.seam.application import ApplicationEvent, CarriedService, ExecuteRequest, ResponseArrived
from plr.sidecar.core.seam.links import SetReady

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.protos.model.ids import Address
    from plr.protos.model.mapping import MappingSet
    from plr.sidecar.core.crypto.session import OwnSession
    from plr.sidecar.core.rules.budget import Budget

SERVICE = ServiceName("/echo")
IPV6 = ":6"
"""Ends the host part of an interface's other address, in a mesh with two; both lead over the same wire."""
ROUNDING_S = 1e-9
TYPE = "plr_test/srv/Echo"


@dataclass
class Wire:
    """What happens to datagrams between two addresses, in one direction."""

    delay_s: float = 0.010
    jitter_s: float = 0.0
    loss: float = 0.0
    duplicate: float = 0.0
    cut: bool = False
    bytes_per_s: float = 0.0
    """0 means no limit."""
    buffer_bytes: float = 0.0
    """What the queue before it holds; 0 means a second of its rate."""
    mtu: int = 65_535
    """Longer packets vanish without a word; datagrams count with IPv4's headers."""
    busy_until: float = 0.0
    carried: int = 0
    overflowed: int = 0
    """Datagrams that found the queue full."""
    longest_wait_s: float = 0.0
    """The longest that a datagram stood in the queue; the test may reset it."""


class Node:
    """One sidecar: an engine and its links, driven by the mesh."""

    def __init__(
        self, mesh: Mesh, name: str, role: Role, interfaces: list[str], rules: tuple[ServiceRule, ...]
    ) -> None:
        self.mesh = mesh
        self.name = NodeName(name)
        self.role = role
        self.interfaces = [InterfaceName(interface) for interface in interfaces]
        self.rules = rules
        self.token = mesh.rng.randbytes(16)
        self.offers: tuple[ServiceOffer, ...] = ()
        self.server_delay: Callable[[], float | None] = lambda: 0.001
        self.answer: Callable[[bytes], bytes] = b"echo:".__add__
        self.judge: Callable[[bytes], str | None] = lambda _answer: None
        """Why an answer cannot be delivered, or None."""
        self.server: Callable[[ApplicationEvent], None] | None = None
        """Runs this cloud's requests in place of `server_delay` and `answer`."""
        self.events: list[ApplicationEvent] = []
        self.alive = True
        self.asleep = False
        self.slept_s = 0.0
        """How long it was suspended: its clock, as CLOCK_MONOTONIC, stood still."""
        self.late_s: Callable[[], float] | None = None
        """How late its threads get their turn on a busy host; what came in the meantime is taken in one go then."""
        self.start()

    @property
    def now(self) -> float:
        """Its own clock (s); rounding must not keep it before its next timer."""
        return self.mesh.now - self.slept_s + (ROUNDING_S if self.slept_s else 0.0)

    def start(self) -> None:
        now = self.now
        self.incarnation = int(now * 1e6) + 1
        self.own, self.announcer = self.mesh.begin_session(self)
        self.session = self.own.credential.session
        self.engine = Engine(EngineConfig(self.role, self.rules, self.mesh.budgets), self.own, now)
        self.links = {
            interface: Link(
                LinkIdentity.of(self.own.credential, self.token, interface, InterfaceId(number)),
                random.Random(self.mesh.rng.random()),
                now,
                limits=self.mesh.key_limits,
                controller=self.mesh.controller,
            )
            for number, interface in enumerate(self.interfaces)
        }
        for link in self.links.values():
            link.execute(SetReady(ready=True), now)
        self.engine.set_interfaces(self.links, now)
        if self.role is Role.CLOUD:
            self.engine.cloud.set_offers(self.offers)
        self.executed: list[RequestId | int] = []
        self.inbox: list[tuple[InterfaceName, bytes, Address]] = []
        self.awaits_turn = False
        self.sequence = 0
        self.alive = True

    def address(self, interface: InterfaceName) -> Address:
        return (f"{self.name}.{interface}", 1)

    def addresses(self, interface: InterfaceName) -> tuple[Address, ...]:
        address = self.address(interface)
        return (address, (address[0] + IPV6, address[1])) if self.mesh.dual_stack else (address,)

    def source(self, interface: InterfaceName, destination: Address) -> Address:
        """Of the destination's family."""
        return next(one for one in self.addresses(interface) if one[0].endswith(IPV6) == destination[0].endswith(IPV6))

    def told_to(self, other: Node) -> Peer:
        """What the control plane tells another sidecar of it."""
        return replace(self.as_peer(), token=pair_token(self.token, other.name, other.role))

    def as_peer(self) -> Peer:
        """With its own token, as it registers."""
        candidates = tuple(
            Candidate(InterfaceId(number), interface, CandidateKind.HOST, address)
            for number, interface in enumerate(self.interfaces)
            for address in self.addresses(interface)
        )
        said = self.announcer.announce(candidates)
        peer = Peer(
            self.name,
            self.role,
            self.session,
            self.token,
            self.incarnation,
            said.candidates,
            self.offers,
            may_call=ALL_CALLS,
            candidates_serial=said.serial,
            candidates_signature=said.signature,
        )
        return replace(peer, credential=self.own.credential.encode())

    def submit(self, payload: bytes, service: ServiceName = SERVICE) -> RequestId:
        self.sequence += 1
        request_id = make_request_id(self.session, b"guid", self.sequence)
        self.engine.robot.requests.submit(request_id, service, payload, self.now)
        self.mesh.pump(self)
        return request_id

    def responses(self) -> list[ResponseArrived]:
        return [event for event in self.events if isinstance(event, ResponseArrived)]

    def next_timer(self) -> float:
        if self.awaits_turn or self.asleep:
            return float("inf")
        return self.slept_s + min(self.engine.next_timer(), *(link.next_timer() for link in self.links.values()))


@dataclass(order=True)
class _Due:
    at: float
    order: int
    act: Callable[[], None] = field(compare=False)


class Mesh:
    """All nodes, the wires between them, and the clock."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        self.now = 1000.0
        self.nodes: dict[str, Node] = {}
        self.wires: dict[tuple[str, str], Wire] = {}
        self._due: list[_Due] = []
        self._order = count()
        self.version = 0
        self.calls = 0
        self.key_limits = DEFAULT_LIMITS
        self.controller = DEFAULT_CONTROLLER
        """The congestion controller of all paths; set it before nodes start."""
        self.budgets: tuple[Budget, ...] = ()
        """Of robots; set it before they start."""
        self.aeads: dict[str, Aead] = {}
        """What nodes prefer other than AES; set it before they start."""
        self.begin_session: Callable[[Node], tuple[OwnSession, Announcer]] = self._begin_session
        """Without certificates, if the test has none."""
        self.dual_stack = False
        """Whether interfaces have an IPv6 address as well; set it before nodes start."""
        self.unreachable: set[str] = set()
        """Host parts of addresses that nothing gets to."""
        self.tap: Callable[[Address, Address, bytes], None] | None = None
        """Sees every datagram that leaves: from where, where to."""

    def _begin_session(self, node: Node) -> tuple[OwnSession, Announcer]:
        session = SessionId(self.rng.getrandbits(64))
        aead = self.aeads.get(node.name, Aead.AES_256_GCM)
        own = session_of(node.name, node.role, session, node.incarnation, aead)
        return own, Announcer(session, None, lambda _: ())

    def add(self, name: str, role: Role, interfaces: list[str], rules: tuple[ServiceRule, ...]) -> Node:
        node = self.nodes[name] = Node(self, name, role, interfaces, rules)
        return node

    def robot(self, *interfaces: str, rules: tuple[ServiceRule, ...] | None = None) -> Node:
        return self.add("robot", Role.ROBOT, list(interfaces), rules or (rule(),))

    def cloud(self, name: str) -> Node:
        node = self.add(name, Role.CLOUD, ["eth0"], (rule(),))
        node.offers = (ServiceOffer(SERVICE, TYPE),)
        node.engine.cloud.set_offers(node.offers)
        return node

    def wire(self, source: str, destination: str) -> Wire:
        """The wire from one address's host part to another's."""
        return self.wires.setdefault((source, destination), Wire())

    def both_ways(self, one: str, other: str) -> tuple[Wire, Wire]:
        return self.wire(one, other), self.wire(other, one)

    def all_wires_of(self, address: str) -> list[Wire]:
        """Every wire from or to one interface, existing ones and those still to come between known nodes."""
        for node in self.nodes.values():
            for interface in node.interfaces:
                host = node.address(interface)[0]
                if host != address:
                    self.both_ways(address, host)
        return [wire for ends, wire in self.wires.items() if address in ends]

    def push_views(self) -> None:
        """What a control plane would do: everybody learns of the other role."""
        self.version += 1
        for node in self.nodes.values():
            peers = tuple(
                other.told_to(node) for other in self.nodes.values() if other.role is not node.role and other.alive
            )
            assert node.engine.apply_peers(PeerSet(Version(self.version), self.version, peers), node.now) is None
            self.pump(node)

    def push_mapping(self, node: Node, mapping: MappingSet) -> str | None:
        return node.engine.apply_mapping(mapping)

    def suspend(self, node: Node, seconds: float) -> None:
        """The node's host sleeps: nothing runs, nothing arrives, its clock stands still."""
        node.asleep = True
        self.run(seconds)
        node.asleep = False
        node.slept_s += seconds
        node.engine.on_woken(seconds, node.now)
        self.pump(node)

    def at(self, delay: float, act: Callable[[], None]) -> None:
        heapq.heappush(self._due, _Due(self.now + delay, next(self._order), act))

    def run(self, seconds: float) -> None:
        end = self.now + seconds
        while True:
            alive = [node for node in self.nodes.values() if node.alive]
            timers = [(node.next_timer(), index) for index, node in enumerate(alive)]
            timer, index = min(timers, default=(end, 0))
            due = self._due[0].at if self._due else float("inf")
            step = min(timer, due)
            if step > end:
                self.now = end
                return
            self.now = max(self.now, step)
            if due <= timer:
                heapq.heappop(self._due).act()
            else:
                node = alive[index]
                if node.late_s is None:
                    self._turn(node)
                else:
                    self._await_turn(node)

    def _await_turn(self, node: Node) -> None:
        if not node.awaits_turn:
            assert node.late_s is not None
            node.awaits_turn = True
            self.at(node.late_s(), lambda: self._turn(node))

    def _turn(self, node: Node) -> None:
        if not node.alive:
            return
        node.awaits_turn = False
        inbox, node.inbox = node.inbox, []
        for interface, data, source in inbox:
            node.links[interface].receive_batch(memoryview(data), len(data), source, node.now)
        node.engine.handle_timer(node.now)
        for link in node.links.values():
            link.handle_timer(node.now)
        self._pump(node)

    def pump(self, node: Node) -> None:
        """Move everything that is ready inside one node, and its datagrams onto the wires; once it has its turn."""
        if node.late_s is None:
            self._pump(node)
        else:
            self._await_turn(node)

    def _pump(self, node: Node) -> None:
        engine, now = node.engine, node.now
        while True:
            busy = False
            for interface, command in engine.take_commands():
                busy = True
                for link in node.links.values() if interface is None else [node.links[interface]]:
                    link.execute(command, now)
            for link in node.links.values():
                while (event := link.next_event()) is not None:
                    busy = True
                    engine.on_link_event(event, now)
            while (decoding := engine.next_decoding()) is not None:
                busy = True
                if decoding.run_slice():
                    engine.on_decoded(decoding, now)
            for application_event in engine.take_events():
                busy = True
                self._application(node, application_event)
            if not busy:
                break
        for interface, link in node.links.items():
            while batches := link.batches_to_send(now):
                for batch in batches:
                    for datagram in batch.cut():
                        self._carry(node.source(interface, batch.address), batch.address, bytes(datagram))
            while (event := link.next_event()) is not None:
                engine.on_link_event(event, now)

    def _application(self, node: Node, event: ApplicationEvent) -> None:
        node.events.append(event)
        if isinstance(event, ResponseArrived):
            problem = node.judge(bytes(event.payload))
            node.engine.robot.requests.judge_answer(event.request_id, event.copy, problem, node.now)
        if node.server is not None:
            node.server(event)
        elif isinstance(event, ExecuteRequest):
            session, execution = node.session, event.execution
            node.executed.append(RequestId(bytes(event.payload)))
            delay = node.server_delay()
            if delay is None:
                return

            def answer() -> None:
                if node.alive and node.session == session:
                    node.engine.cloud.complete(execution, node.answer(bytes(event.payload)), delay, node.now)
                    self.pump(node)

            self.at(delay, answer)
        elif type(event).__name__ == "OfferService":
            node.engine.robot.set_carried(frozenset(map(CarriedService, node.engine.robot.catalog.offered)))

    def _carry(self, source: Address, destination: Address, data: bytes) -> None:
        if self.tap is not None:
            self.tap(source, destination, data)
        if destination[0] in self.unreachable:
            return
        wire = self.wire(source[0].removesuffix(IPV6), destination[0].removesuffix(IPV6))
        wire.carried += len(data)
        copies = 2 if self.rng.random() < wire.duplicate else 1
        for _ in range(copies):
            if wire.cut or len(data) + HEADERS_V4 > wire.mtu or self.rng.random() < wire.loss:
                continue
            start = max(self.now, wire.busy_until)
            if wire.bytes_per_s:
                wait = start - self.now
                if wait * wire.bytes_per_s > (wire.buffer_bytes or wire.bytes_per_s):
                    wire.overflowed += 1
                    continue
                wire.longest_wait_s = max(wire.longest_wait_s, wait)
                wire.busy_until = start = start + len(data) / wire.bytes_per_s
            arrival = start - self.now + wire.delay_s + self.rng.uniform(0, wire.jitter_s)
            self.at(arrival, lambda: self._arrive(source, destination, data))

    def inject(self, source: Address, destination: Address, data: bytes) -> None:
        """Let a datagram arrive that nobody sent, or that somebody else did."""
        self._arrive(source, destination, data)

    def _arrive(self, source: Address, destination: Address, data: bytes) -> None:
        name, interface = destination[0].removesuffix(IPV6).rsplit(".", 1)
        node = self.nodes.get(name)
        if node is None or not node.alive or node.asleep:
            return
        if node.late_s is None:
            node.links[InterfaceName(interface)].receive_batch(memoryview(data), len(data), source, node.now)
        else:
            node.inbox.append((InterfaceName(interface), data, source))
        self.pump(node)


def rule(**changes: object) -> ServiceRule:
    values: dict[str, object] = {
        "pattern": SERVICE,
        "deadline_s": 0.1,
        "lifetime_s": 10.0,
        "idempotent": True,
    }
    return ServiceRule(**{**values, **changes})  # type: ignore[arg-type]  # test convenience
