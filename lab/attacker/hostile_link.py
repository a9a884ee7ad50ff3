"""Turns an interface of a compromised member hostile: besides honest datagrams it sends all that its keys allow.

It runs on the sidecar's own thread, over its own socket, with its real paths, keys and packet numbers.
"""

from __future__ import annotations

import random
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from lab.attacker.false_sessions import FalseSessions
from lab.attacker.orders import Stage
from lab.attacker.spoofing import Spoofer
from plr.protos.model.ids import Role, ServiceName
from plr.sidecar.core.base.values import PathState, Priority, RejectReason, RequestId
from plr.sidecar.core.crypto.key_schedule import proof_of_offer
from plr.sidecar.core.crypto.session import public_key
from plr.sidecar.core.link.link import Link
from plr.sidecar.core.link.sender import Batch
from plr.sidecar.core.wire import frame
from plr.sidecar.core.wire.messages import (
    CancelMessage,
    Message,
    RejectionMessage,
    RequestMessage,
    ResponseMessage,
    encode_message,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from lab.attacker.hostile_means import Means
    from plr.sidecar.core.path.path import Path
    from plr.sidecar.core.seam.links import LinkPeer

SYMBOL = 1024
ESCAPES = "\x1b[2J\x1b]0;owned\x07\r\n2026-01-01T00:00:00.000Z INFO runtime: all is well \u202e\x00\x9b31m"
"""Sequences that a terminal would obey, and text that would pass for another line of the log."""
OFFERS_A_BURST = 1000
"""Key offers sent back to back: about 10,000 a second while the burst lasts."""
LARGE_ANSWER = "0 500000"
"""`format` of a request for half a megabyte back (lab/echo.py)."""
MAX_MESSAGE = 16 << 20


@dataclass(frozen=True, slots=True)
class Attack:
    """An attack that is repeated on the live path of each peer."""

    name: str
    """Name in the report."""
    every_s: float
    make: Callable[[HostileLink, Path], Iterable[bytes]]
    """Makes the datagrams of one run on one path."""
    stages: frozenset[Stage] = frozenset({Stage.STEADY, Stage.SPOOFING})
    role: Role | None = None
    """Role of the attacker; None for either."""


class HostileLink(Link):
    """A link that attacks when its orders say so."""

    means: Means
    """Set on the class before any instance exists."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.rng = random.Random(self.identity.session)
        self.sessions = FalseSessions(self.identity, self.means.key)
        self._spoofer = Spoofer()
        self._message = 1 << 40
        # Spread the attacks over time.
        self._due = {
            attack: time.monotonic() + attack.every_s * self.rng.random()
            for attack in ATTACKS
            if attack.role in (None, self.identity.role)
        }
        self._last_requests: list[RequestId] = []

    # -- what the driver calls ------------------------------------------------------------------------------------

    def next_timer(self) -> float:
        """Return the earlier of the link's next timer and the next attack."""
        honest = super().next_timer()
        stage = self.means.commander.stage
        due = min((at for attack, at in self._due.items() if stage in attack.stages), default=honest)
        return min(honest, due)

    def batches_to_send(self, now: float) -> list[Batch]:
        """Return the honest batches, and those of attacks that are due."""
        batches = super().batches_to_send(now)
        stage = self.means.commander.stage
        for attack, due in self._due.items():
            if stage in attack.stages and due <= now:
                self._due[attack] = now + attack.every_s
                if self.means.commander.want(attack.name):
                    batches += self._run(attack)
        return batches

    def _run(self, attack: Attack) -> list[Batch]:
        batches: list[Batch] = []
        if attack.name == NEW_SESSIONS:
            self.sessions.begin()
        for path in list(self._paths.values()):
            known = path.remote is not None and path.peer in self.means.names
            if not known or (path.state is not PathState.UP and Stage.RESTARTING not in attack.stages):
                continue
            made = list(attack.make(self, path))
            assert path.remote is not None
            if attack.stages in (_SPOOFED, _ACKNOWLEDGING):
                for datagram in made:
                    self._spoofer.send(datagram, self.means.third_party, path.remote)
            else:
                batches += [Batch(path.remote, datagram, len(datagram)) for datagram in made]
            self.means.tally.add(attack.name, len(made), sum(map(len, made)))
        return batches

    # -- datagrams ------------------------------------------------------------------------------------------------

    def sealed(self, path: Path, *frames: bytes) -> bytes:
        """Return a datagram of the path, as authentic as any."""
        return self._builder._sealed(path, path.recovery.take_numbers(), time.monotonic(), *frames)

    def peer(self, path: Path) -> LinkPeer | None:
        """Return the peer at the other end of the path."""
        return self._table.by_session.get(path.session)

    def said(self, path: Path, *messages: Message) -> Iterator[bytes]:
        """Yield short messages, each in a datagram of its own."""
        for message in messages:
            content = b"".join(encode_message(message))
            self._message += 1
            yield self.sealed(path, frame.encode_fragment_head(self._message, len(content), SYMBOL, 0), content)

    def requests(self, path: Path, count: int, payload: bytes) -> Iterator[bytes]:
        """Yield requests that it may make, as urgent as possible."""
        ids = [RequestId(self.rng.randbytes(16)) for _ in range(count)]
        self._last_requests = (self._last_requests + ids)[-1000:]
        service, kind = self.means.service
        for request_id in ids:
            yield from self.said(
                path, RequestMessage(request_id, 0, Priority.HIGH, 0.05, 60.0, ServiceName(service), kind, payload)
            )

    def some_requests(self, count: int) -> list[RequestId]:
        """Return ids of requests that it made, and of some that nobody made."""
        made = [self.rng.choice(self._last_requests) for _ in range(count // 2) if self._last_requests]
        return [*made, *(RequestId(self.rng.randbytes(16)) for _ in range(count - len(made)))]


# -- the attacks --------------------------------------------------------------------------------------------------


def _phantoms(link: HostileLink, path: Path) -> Iterable[bytes]:
    peer = link.peer(path)
    return () if peer is None else link.sessions.phantoms(path, peer)


def _new_sessions(link: HostileLink, path: Path) -> Iterable[bytes]:
    peer = link.peer(path)
    return () if peer is None else link.sessions.restarted(path, peer)


def _forged_restarts(link: HostileLink, path: Path) -> Iterable[bytes]:
    peer = link.peer(path)
    return () if peer is None else [link.sessions.forged_restart(path, peer) for _ in range(5)]


def _replays(link: HostileLink, path: Path) -> Iterable[bytes]:
    peer = link.peer(path)
    return () if peer is None else [link.sessions.replay(path, peer)] * 10


def _wrong_offers(link: HostileLink, path: Path) -> Iterable[bytes]:
    offer = frame.KeyOffer(path.sealing.phase + 1, link.rng.randbytes(32), link.rng.randbytes(16))
    frames = frame.encode_key_offer(offer)
    return [link.sealed(path, frames) for _ in range(OFFERS_A_BURST)]


def _other_offers(link: HostileLink, path: Path) -> Iterable[bytes]:
    """Offer a different key each time, with a valid proof."""
    phase = path.sealing.phase + 1
    for _ in range(10):
        key = public_key(link.rng.randbytes(32))
        proof = proof_of_offer(path.keys._exchange._root, phase, key)
        yield link.sealed(path, frame.encode_key_offer(frame.KeyOffer(phase, key, proof)))


def _wrong_answers(link: HostileLink, path: Path) -> Iterable[bytes]:
    for phase in (path.sealing.phase, path.sealing.phase + 1, link.rng.getrandbits(32)):
        answer = frame.KeyAnswer(phase, link.rng.randbytes(32), link.rng.randbytes(16))
        for _ in range(10):
            yield link.sealed(path, frame.encode_key_answer(answer))


def _fuzz(link: HostileLink, path: Path) -> Iterable[bytes]:
    """Send invalid frames, and frames with meaningless numbers; acknowledgements are an attack of their own."""
    rng = link.rng
    for _ in range(10):
        number = rng.getrandbits(rng.choice((8, 40, 64)))
        match rng.randrange(6):
            case 0:
                # A first byte of 0 would be padding, 3 or 8 an acknowledgement or a goodbye.
                yield link.sealed(path, b"\x0d" + rng.randbytes(rng.randint(1, 1000)))
            case 1:
                about = (
                    frame.encode_finished(frame.Finished(number)),
                    frame.encode_abandon(frame.Abandon(number)),
                    frame.encode_forgotten(frame.Forgotten(number)),
                )
                yield link.sealed(path, rng.choice(about))
            case 2:
                yield link.sealed(path, *(frame.encode_probe(frame.Probe(rng.getrandbits(64))) for _ in range(40)))
            case 3:
                yield link.sealed(path, frame.encode_probe_reply(frame.ProbeReply(number)))
            case 4:
                # The first symbol of a message of up to the maximum size that never continues.
                total = rng.choice((MAX_MESSAGE, rng.randint(SYMBOL, MAX_MESSAGE)))
                yield link.sealed(path, frame.encode_fragment_head(number, total, SYMBOL, 0), rng.randbytes(SYMBOL))
            case _:
                yield link.sealed(path, frame.encode_fragment_head(number, 600, SYMBOL, 0), rng.randbytes(600))


def _request_flood(link: HostileLink, path: Path) -> Iterable[bytes]:
    return link.requests(path, 10, link.means.request)


def _cancel_flood(link: HostileLink, path: Path) -> Iterable[bytes]:
    return link.said(path, *map(CancelMessage, link.some_requests(20)))


def _answers_unasked(link: HostileLink, path: Path) -> Iterable[bytes]:
    ids = [RequestId(link.rng.randbytes(16)) for _ in range(4)]
    return link.said(
        path,
        *(ResponseMessage(one, 0, 0.0, link.rng.randbytes(64)) for one in ids[:2]),
        *(RejectionMessage(one, 0, RejectReason.OVERLOADED, ESCAPES) for one in ids[2:]),
    )


def _spoofed_requests(link: HostileLink, path: Path) -> Iterable[bytes]:
    return link.requests(path, 2, link.means.request_of_much)


def _blind_acks(link: HostileLink, path: Path) -> Iterable[bytes]:
    seen = path.received.largest
    for ahead in (1, 4, 16, 64, 256):
        yield link.sealed(path, frame.encode_ack([(max(0, seen - 60_000), seen + ahead)], 0.0))


def spoofed() -> frozenset[str]:
    """Return the attacks whose datagrams claim to come from the third party."""
    return frozenset(attack.name for attack in ATTACKS if attack.stages in (_SPOOFED, _ACKNOWLEDGING))


NEW_SESSIONS = "sessions begun, 31 interfaces each"
_SPOOFED = frozenset({Stage.SPOOFING})
_ACKNOWLEDGING = frozenset({Stage.ACKNOWLEDGING})
_RESTARTING = frozenset({Stage.RESTARTING})
ATTACKS = (
    Attack("phantom interfaces", 1.0, _phantoms),
    Attack(NEW_SESSIONS, 1.05, _new_sessions, _RESTARTING),
    Attack("forged restarts", 0.1, _forged_restarts),
    Attack("replayed introductions", 0.1, _replays),
    Attack("introductions replayed from a third party", 0.02, _replays, _SPOOFED),
    Attack("requests from a third party's address", 0.25, _spoofed_requests, _SPOOFED, Role.ROBOT),
    Attack("blind acknowledgements", 0.05, _blind_acks, _ACKNOWLEDGING),
    Attack("offers of keys with wrong proofs", 1.0, _wrong_offers, role=Role.ROBOT),
    Attack("other offers of keys", 0.1, _other_offers, role=Role.ROBOT),
    Attack("wrong answers to offers of keys", 0.2, _wrong_answers, role=Role.CLOUD),
    Attack("fuzzed datagrams, rightly sealed", 0.05, _fuzz),
    Attack("small requests", 0.1, _request_flood, role=Role.ROBOT),
    Attack("cancels", 0.1, _cancel_flood, role=Role.ROBOT),
    Attack("answers that nobody asked for", 0.1, _answers_unasked, role=Role.CLOUD),
)
