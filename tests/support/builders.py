"""Short ways to make what the cores' tests need."""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from lab.simulated.sessions import agree, credential_of, seal, session_of, with_credential
from plr.protos.model.ids import Address, InterfaceId, InterfaceName, NodeName, Role, ServiceName, SessionId
from plr.protos.model.members import ALL_CALLS, Candidate, CandidateKind, Peer, ServiceOffer
from plr.protos.trust.pair_token import pair_token
from plr.sidecar.core.base.values import PathId, Priority, RequestId
from plr.sidecar.core.crypto.aead import TAG_BYTES
from plr.sidecar.core.link.link import Link
from plr.sidecar.core.link.memory import LinkMemory
from plr.sidecar.core.link.sender import LinkIdentity
from plr.sidecar.core.message.symbols import MessageSymbols
from plr.sidecar.core.path.key_exchange import DEFAULT_LIMITS
from plr.sidecar.core.path.keys import PathKeys, make_path_keys
from plr.sidecar.core.path.pmtu import HEADERS_V4
from plr.sidecar.core.rules.service_rule import ServiceRule
from plr.sidecar.core.seam.links import LinkCommand, LinkEvent, LinkPeer, SetMtu, SetPeers, SetReady
from plr.sidecar.core.wire.frame import (
    BASE_BYTES,
    HEADER_BYTES,
    INTRODUCTION_FLAG,
    NONCE_OFFSET,
    Frame,
    Header,
    decode_frames,
    decode_header,
)
from plr.sidecar.core.wire.introduction import Introduction, encode_introduction, open_introduction
from plr.sidecar.core.wire.messages import Encoded, RequestMessage

if TYPE_CHECKING:
    from collections.abc import Iterable

WLAN, WWAN = InterfaceName("wlan0"), InterfaceName("wwan0")
A, B = NodeName("cloud-a"), NodeName("cloud-b")
ECHO = ServiceName("/echo")
TYPE = "t/srv/Echo"
OUR_NAME, OUR_ID, OUR_INCARNATION = NodeName("robot-1"), InterfaceId(3), 7
FIRST = InterfaceId(0)
OUR_SESSION, PEER_SESSION = SessionId(0x0102030405060708), SessionId(0x1112131415161718)
OUR_TOKEN, PEER_TOKEN = bytes(range(16)), bytes(range(16, 32))
PEER_ADDRESS = ("192.0.2.1", 4000)
Addresses = tuple[tuple[InterfaceId, tuple[Address, ...]], ...]
ADDRESSES: Addresses = ((FIRST, (PEER_ADDRESS,)),)


def path(interface: str = WLAN, peer: str = A, remote: int = 0) -> PathId:
    return PathId(InterfaceName(interface), NodeName(peer), InterfaceId(remote))


def message(
    number: int = 1,
    size: int = 3000,
    *,
    priority: Priority = Priority.NORMAL,
    deadline: float = 10.0,
    expires: float = 20.0,
    siblings: list[MessageSymbols] | None = None,
    repeats: float | None = None,
) -> MessageSymbols:
    data = random.Random(number).randbytes(size)
    content = Encoded(b"", data)
    return MessageSymbols(
        number,
        content,
        priority=priority,
        deadline=deadline,
        expires=expires,
        siblings=siblings,
        repeats=repeats,
    )


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
    role: Role = Role.CLOUD,
    offers: tuple[ServiceOffer, ...] = (ServiceOffer(ECHO, TYPE),),
    draining: bool = False,
) -> Peer:
    candidate = Candidate(InterfaceId(0), InterfaceName("eth0"), CandidateKind.HOST, PEER_ADDRESS)
    token = NodeName(name).encode().ljust(16)[:16]
    subject = Peer(
        NodeName(name),
        role,
        SessionId(session),
        token,
        incarnation,
        (candidate,),
        offers,
        draining,
        may_call=ALL_CALLS,
    )
    return with_credential(subject)


@dataclass
class Bench:
    """One link with one known peer, whose datagrams the test writes itself."""

    link: Link = field(init=False)
    now: float = 1.0
    number: int = -1
    first_number: int = 0
    exchanges_keys: bool = True
    """Both ends have fresh keys as soon as there is a path; otherwise the test does it."""

    def __post_init__(self) -> None:
        self.own = session_of(OUR_NAME, Role.ROBOT, OUR_SESSION, OUR_INCARNATION)
        self.session = PEER_SESSION
        """The peer's, as the link knows it."""
        self._incarnations = {PEER_SESSION: 1}
        self._peer_keys: dict[tuple[SessionId, InterfaceId], PathKeys] = {}
        identity = LinkIdentity.of(self.own.credential, OUR_TOKEN, WLAN, OUR_ID)
        self.link = Link(identity, random.Random(1), self.now, LinkMemory(self.first_number))
        self.know()
        self.link.execute(SetMtu(BASE_BYTES + HEADERS_V4), self.now)  # no search: tests count datagrams
        self.link.execute(SetReady(ready=True), self.now)

    def know(self, *, session: SessionId = PEER_SESSION, incarnation: int = 1, name: NodeName = A) -> None:
        self.execute(SetPeers((self.link_peer(session=session, incarnation=incarnation, name=name),)))

    def link_peer(
        self,
        *,
        session: SessionId = PEER_SESSION,
        incarnation: int = 1,
        name: NodeName = A,
        addresses: Addresses = ADDRESSES,
        token: bytes = PEER_TOKEN,
    ) -> LinkPeer:
        """A cloud as the engine would tell the link of it."""
        if name == A:
            self.session, self._incarnations[session] = session, incarnation
        subject = with_credential(Peer(name, Role.CLOUD, session, token, incarnation))
        return LinkPeer(name, session, token, incarnation, subject.credential, self.own.admit(subject), addresses)

    def peer_keys(self, session: SessionId = PEER_SESSION, interface: InterfaceId = FIRST) -> PathKeys:
        """The other end's keys of the path to this interface of a session of A."""
        if (session, interface) not in self._peer_keys:
            us = Peer(OUR_NAME, Role.ROBOT, OUR_SESSION, OUR_TOKEN, OUR_INCARNATION)
            theirs = session_of(A, Role.CLOUD, session, self._incarnations.get(session, 1))
            pair = theirs.admit(with_credential(us))
            self._peer_keys[session, interface] = make_path_keys(
                pair, interface, OUR_ID, DEFAULT_LIMITS, self.now, leads=False
            )
        return self._peer_keys[session, interface]

    def fresh_peer_keys(self, session: SessionId = PEER_SESSION, interface: InterfaceId = FIRST) -> PathKeys:
        """The same, after an exchange if there was none and the test does not do it."""
        keys = self.peer_keys(session, interface)
        path = self.link._paths.get((A, interface)) if self.exchanges_keys else None
        if path is not None and path.session == session and path.keys.sealing.phase == keys.sealing.phase == 0:
            agree(path.keys, keys, self.now, random.Random(2))
        return keys

    def datagram(
        self,
        *frames: bytes,
        number: int | None = None,
        session: SessionId = PEER_SESSION,
        interface: InterfaceId = FIRST,
        receiver: InterfaceId = OUR_ID,
    ) -> bytes:
        """What the peer would send."""
        if number is None:
            self.number += 1
            number = self.number
        header = Header(interface, receiver, session, number)
        return seal(self.fresh_peer_keys(session, interface).sealing, header, b"".join(frames))

    def introduction(
        self,
        *,
        number: int = 0,
        interface: InterfaceId = FIRST,
        session: SessionId = PEER_SESSION,
        incarnation: int = 1,
        token: bytes = PEER_TOKEN,
        name: NodeName = A,
        receiver: NodeName = OUR_NAME,
    ) -> bytes:
        """What the peer would send over a path that is down; its probe is 77."""
        header = Header(interface, OUR_ID, session, number)
        credential = credential_of(name, Role.CLOUD, session, incarnation).encode()
        return encode_introduction(header, token, receiver, 77, credential)

    def opened(self, datagram: bytes) -> list[Frame | Introduction]:
        """What the peer reads in a datagram of the link: frames, or an introduction."""
        header = decode_header(datagram)
        if header.flags & INTRODUCTION_FLAG:
            return [open_introduction(header, memoryview(datagram), pair_token(OUR_TOKEN, A, Role.CLOUD), A)]
        return [*decode_frames(memoryview(self.plain(datagram)))]

    def plain(self, datagram: bytes) -> bytes:
        """The frames' bytes in a datagram of the link that is no introduction."""
        opening = self.peer_keys(self.session, decode_header(datagram).receiver_interface).opening
        clear, plain = datagram[:HEADER_BYTES], bytearray(len(datagram) - HEADER_BYTES - TAG_BYTES)
        opening.decrypt_into(clear[NONCE_OFFSET:], datagram[HEADER_BYTES:], clear, plain)
        return bytes(plain)

    def frames(self, datagrams: Iterable[bytes]) -> list[Frame | Introduction]:
        """As `opened`, of them all."""
        return [item for datagram in datagrams for item in self.opened(datagram)]

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
