"""Sessions for tests: their keys follow from name and session, and every credential that is well formed is believed."""

from __future__ import annotations

import hashlib
import math
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

from plr.protos.model.ids import NodeName, Role, SessionId
from plr.protos.trust.credential import Aead, SessionCredential
from plr.sidecar.core.crypto.aead import NONCE_BYTES, TAG_BYTES
from plr.sidecar.core.crypto.session import OwnSession, public_key
from plr.sidecar.core.wire.frame import HEADER_BYTES, PHASE_FLAG, Header, encode_header

if TYPE_CHECKING:
    import random

    from plr.protos.model.members import Peer
    from plr.sidecar.core.path.keys import PathKeys, SealingKeys


@lru_cache(maxsize=65536)
def private_key(name: str, session: int) -> bytes:
    return hashlib.sha256(f"{name} {session}".encode()).digest()


@lru_cache(maxsize=65536)
def credential_of(
    name: str, role: Role, session: int, incarnation: int = 1, aead: Aead = Aead.AES_256_GCM
) -> SessionCredential:
    key = public_key(private_key(name, session))
    return SessionCredential(NodeName(name), role, SessionId(session), incarnation, key, aead)


def session_of(name: str, role: Role, session: int, incarnation: int = 1, aead: Aead = Aead.AES_256_GCM) -> OwnSession:
    return OwnSession(
        credential_of(name, role, session, incarnation, aead), private_key(name, session), lambda credential: math.inf
    )


def with_credential(peer: Peer, aead: Aead = Aead.AES_256_GCM) -> Peer:
    """The peer with a credential that fits it."""
    credential = credential_of(peer.name, peer.role, peer.session, peer.incarnation, aead)
    return replace(peer, credential=credential.encode())


def agree(leader: PathKeys, follower: PathKeys, now: float, rng: random.Random) -> None:
    """Both ends of a path exchange fresh keys, without a datagram."""
    offer = leader.offer(now, rng)
    assert offer is not None
    answer = follower.answer(offer, now, rng)
    assert answer is not None
    assert leader.take(answer, now)
    follower.opening.advance(0)
    assert follower.follow(now)
    leader.opening.advance(0)


def seal(sealing: SealingKeys, header: Header, plain: bytes) -> bytes:
    """Return a datagram sealed with a path's present keys, whose interfaces may be the header's own."""
    clear = encode_header(header._replace(flags=header.flags | sealing.phase % 2 * PHASE_FLAG))
    out = bytearray(len(plain) + TAG_BYTES)
    sealing.encrypt_into(clear[HEADER_BYTES - NONCE_BYTES :], plain, clear, out)
    return clear + out
