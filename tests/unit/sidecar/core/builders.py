"""Short ways to make what the cores' tests need."""

from __future__ import annotations

import random
from dataclasses import dataclass, field

from protos.model import (
    ALL_CALLS,
    Address,
    Candidate,
    CandidateKind,
    InterfaceId,
    InterfaceName,
    NodeName,
    Peer,
    Role,
    ServiceName,
    ServiceOffer,
    SessionId,
)
from sidecar.core.datagrams import LinkIdentity
from sidecar.core.events import RequestId
from sidecar.core.frame import Header, encode_header
from sidecar.core.link import Link
from sidecar.core.link_events import (
    LinkCommand,
    LinkEvent,
    LinkPeer,
    SetMtu,
    SetPeers,
    SetReady,
)
from sidecar.core.messages import Encoded, RequestMessage
from sidecar.core.outbound import OutboundMessage
from sidecar.core.path_id import PathId
from sidecar.core.pmtu import BASE_BYTES, HEADERS_V4
from sidecar.core.priority import Priority
from sidecar.core.rules import ServiceRule

WLAN, WWAN = InterfaceName("wlan0"), InterfaceName("wwan0")
A, B = NodeName("cloud-a"), NodeName("cloud-b")
ECHO = ServiceName("/echo")
TYPE = "t/srv/Echo"
OUR_SESSION, PEER_SESSION = SessionId(0x0102030405060708), SessionId(0x1112131415161718)
OUR_TOKEN, PEER_TOKEN = bytes(range(16)), bytes(range(16, 32))
PEER_ADDRESS = ("192.0.2.1", 4000)


def path(interface: str = WLAN, peer: str = A, remote: int = 0) -> PathId:
    return PathId(InterfaceName(interface), NodeName(peer), InterfaceId(remote))


def message(
    number: int = 1,
    size: int = 3000,
    *,
    priority: Priority = Priority.NORMAL,
    deadline: float = 10.0,
    expires: float = 20.0,
    over: PathId | None = None,
) -> OutboundMessage:
    data = random.Random(number).randbytes(size)
    content = Encoded(b"", data)
    return OutboundMessage(number, over or path(), content, priority=priority, deadline=deadline, expires=expires)


def request_id(number: int) -> RequestId:
    return RequestId(number.to_bytes(16, "big"))


def request(
    number: int = 1,
    copy: int = 0,
    *,
    deadline_s: float = 1.0,
    lifetime_s: float = 10.0,
    service: ServiceName = ECHO,
) -> RequestMessage:
    return RequestMessage(request_id(number), copy, Priority.NORMAL, deadline_s, lifetime_s, service, TYPE, b"question")


def rule(pattern: str = ECHO, *, idempotent: bool = True, lifetime_s: float = 10.0) -> ServiceRule:
    return ServiceRule(pattern, 0.1, lifetime_s, idempotent=idempotent)


def peer(
    name: str = A,
    *,
    session: int = 1,
    incarnation: int = 1,
    offers: tuple[ServiceOffer, ...] = (ServiceOffer(ECHO, TYPE),),
    draining: bool = False,
) -> Peer:
    candidate = Candidate(InterfaceId(0), InterfaceName("eth0"), CandidateKind.HOST, PEER_ADDRESS)
    token = NodeName(name).encode().ljust(16)[:16]
    return Peer(
        NodeName(name),
        Role.CLOUD,
        SessionId(session),
        token,
        incarnation,
        (candidate,),
        offers,
        draining,
        may_call=ALL_CALLS,
    )


@dataclass
class Bench:
    """One link with one known peer, whose datagrams the test writes itself."""

    link: Link = field(init=False)
    now: float = 1.0
    number: int = -1
    first_number: int = 0

    def __post_init__(self) -> None:
        identity = LinkIdentity(WLAN, InterfaceId(3), OUR_SESSION, OUR_TOKEN, 7)
        self.link = Link(identity, random.Random(1), self.now, self.first_number)
        self.know()
        self.link.execute(SetMtu(BASE_BYTES + HEADERS_V4), self.now)  # no search: tests count datagrams
        self.link.execute(SetReady(ready=True), self.now)

    def know(self, *, session: SessionId = PEER_SESSION, incarnation: int = 1, name: NodeName = A) -> None:
        addresses = ((InterfaceId(0), (PEER_ADDRESS,)),)
        self.link.execute(SetPeers((LinkPeer(name, session, PEER_TOKEN, incarnation, addresses),)), self.now)

    def datagram(self, *frames: bytes, number: int | None = None, session: SessionId = PEER_SESSION) -> bytes:
        """What the peer would send."""
        if number is None:
            self.number += 1
            number = self.number
        return encode_header(Header(InterfaceId(0), InterfaceId(3), session, number)) + b"".join(frames)

    def receive(self, *frames: bytes, number: int | None = None) -> None:
        self.receive_datagram(self.datagram(*frames, number=number))

    def receive_datagram(self, data: bytes, source: Address = PEER_ADDRESS) -> None:
        self.link.receive_batch(memoryview(data), len(data) or 1, source, self.now)

    def execute(self, command: LinkCommand) -> None:
        self.link.execute(command, self.now)

    def sent(self) -> list[bytes]:
        """What the link sends now."""
        out: list[bytes] = []
        while batches := self.link.batches_to_send(self.now):
            out += [bytes(datagram) for batch in batches for datagram in batch.cut()]
        return out

    def events(self) -> list[LinkEvent]:
        out = []
        while (event := self.link.next_event()) is not None:
            out.append(event)
        return out

    def wait(self, seconds: float) -> list[bytes]:
        """Let time pass; returns what the link sent meanwhile."""
        end = self.now + seconds
        out: list[bytes] = []
        while (timer := self.link.next_timer()) <= end:
            assert timer >= self.now, "a timer in the past that nothing clears"
            self.now = timer
            self.link.handle_timer(self.now)
            out += self.sent()
            assert self.link.next_timer() > self.now, "the timer spins"
        self.now = end
        return out
