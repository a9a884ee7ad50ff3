"""Sessions for tests: their keys follow from name and session, and every credential that is well formed is believed."""

from __future__ import annotations

import hashlib
import math
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

from protos.credential import Aead, SessionCredential
from protos.model import NodeName, Peer, Role, SessionId
from sidecar.core.aead import NONCE_BYTES, TAG_BYTES
from sidecar.core.frame import HEADER_BYTES, Header, encode_header
from sidecar.core.session import OwnSession, public_key

if TYPE_CHECKING:
    from sidecar.core.path_keys import SealingKeys


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


def with_credential(peer: Peer) -> Peer:
    """The peer with a credential that fits it."""
    return replace(peer, credential=credential_of(peer.name, peer.role, peer.session, peer.incarnation).encode())


def seal(sealing: SealingKeys, header: Header, plain: bytes) -> bytes:
    """Return a datagram sealed with a path's present keys, whose interfaces and phase may be the header's own."""
    clear = encode_header(header)
    out = bytearray(len(plain) + TAG_BYTES)
    sealing.encrypt_into(clear[HEADER_BYTES - NONCE_BYTES :], plain, clear, out)
    return clear + out
