"""Makes introductions besides a member's own: of interfaces and sessions that do not exist, genuine or forged."""

from __future__ import annotations

import os
import random
from dataclasses import replace
from typing import TYPE_CHECKING

from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey

from plr.protos.model.ids import InterfaceId, Role
from plr.protos.trust.credential import decode_credential, session_number
from plr.protos.trust.pair_token import pair_token
from plr.sidecar.core.crypto.aead import TAG_BYTES
from plr.sidecar.core.crypto.key_schedule import pair_keys
from plr.sidecar.core.crypto.session import public_key
from plr.sidecar.core.path.key_exchange import DEFAULT_LIMITS
from plr.sidecar.core.path.keys import make_path_keys
from plr.sidecar.core.wire import frame
from plr.sidecar.core.wire.frame import HEADER_BYTES, NONCE_OFFSET, Header
from plr.sidecar.core.wire.introduction import encode_introduction

if TYPE_CHECKING:
    from collections.abc import Iterator

    from cryptography.hazmat.primitives.asymmetric import ec

    from plr.protos.trust.credential import SessionCredential
    from plr.sidecar.core.crypto.key_schedule import PairKeys
    from plr.sidecar.core.link.sender import LinkIdentity
    from plr.sidecar.core.path.keys import SealingKeys
    from plr.sidecar.core.path.path import Path
    from plr.sidecar.core.seam.links import LinkPeer

PHANTOMS = range(200, 231)
"""Numbers of interfaces that no host here has; with the member's own, as many as a peer may introduce."""


class FalseSessions:
    """Makes the false datagrams of one member."""

    def __init__(self, identity: LinkIdentity, key: ec.EllipticCurvePrivateKey) -> None:
        """Prepare; `key` is that of its certificate, with which it signs anything."""
        self._identity = identity
        self._key = key
        self._rng = random.Random(identity.session)
        self._number = 0
        self._later = 0
        self._private = b""
        self._credential: SessionCredential | None = None
        self._known: dict[tuple[str, int, int, int], tuple[SealingKeys, frame.KeyOffer | None]] = {}
        """State made once for each phantom, so that the attack costs the attacker little."""

    def phantoms(self, path: Path, peer: LinkPeer) -> Iterator[bytes]:
        """Introduce interfaces in the present session, each with an offer of keys that is never followed, and probe."""
        yield from self._introduced(path, peer, decode_credential(self._identity.credential), peer.keys)

    def forged_restart(self, path: Path, peer: LinkPeer) -> bytes:
        """Introduce a newer session whose credential nobody has signed."""
        own = decode_credential(self._identity.credential)
        newer = self._newer(own, os.urandom(32))
        forged = replace(newer, signature=self._rng.randbytes(len(own.signature)))
        return self._introduction(path, peer, forged, self._identity.interface_id)

    def replay(self, path: Path, peer: LinkPeer) -> bytes:
        """Return an introduction with an old packet number, as if it had been recorded."""
        own = decode_credential(self._identity.credential)
        return self._introduction(path, peer, own, self._identity.interface_id, number=1)

    def begin(self) -> None:
        """Begin another session, as a restarted sidecar does."""
        own = decode_credential(self._identity.credential)
        self._private = os.urandom(32)
        self._credential = self._newer(own, public_key(self._private)).sign(self._key)

    def restarted(self, path: Path, peer: LinkPeer) -> Iterator[bytes]:
        """Introduce the interfaces of the session begun last."""
        if self._credential is None:
            return
        own, theirs = self._credential, decode_credential(peer.credential)
        private = X25519PrivateKey.from_private_bytes(self._private)
        keys = pair_keys(private, X25519PublicKey.from_public_bytes(theirs.public_key), own, theirs)
        # The first introduction makes the session known.
        yield self._introduction(path, peer, own, InterfaceId(PHANTOMS[0]))
        yield from self._introduced(path, peer, own, keys)

    def _newer(self, own: SessionCredential, public: bytes) -> SessionCredential:
        self._later += 1
        number = session_number(own.name, own.role, public)
        return replace(own, session=number, incarnation=own.incarnation + self._later, public_key=public)

    def _introduced(self, path: Path, peer: LinkPeer, own: SessionCredential, keys: PairKeys) -> Iterator[bytes]:
        for interface in map(InterfaceId, PHANTOMS):
            key = peer.name, path.remote_id, own.session, interface
            if key not in self._known:
                leads = own.role is Role.ROBOT
                phantom = make_path_keys(keys, interface, path.remote_id, DEFAULT_LIMITS, 0.0, leads=leads)
                self._known[key] = phantom.sealing, phantom.offer(0.0, self._rng)
            sealing, offer = self._known[key]
            yield self._introduction(path, peer, own, interface, offer=offer)
            self._number += 1
            head = Header(interface, path.remote_id, own.session, self._number)
            yield seal(sealing, head, frame.encode_probe(frame.Probe(self._rng.getrandbits(64))))

    def _introduction(
        self,
        path: Path,
        peer: LinkPeer,
        own: SessionCredential,
        interface: InterfaceId,
        number: int | None = None,
        offer: frame.KeyOffer | None = None,
    ) -> bytes:
        self._number += 1
        head = Header(interface, path.remote_id, own.session, self._number if number is None else number)
        token = pair_token(self._identity.token, peer.name, Role.CLOUD if own.role is Role.ROBOT else Role.ROBOT)
        return encode_introduction(head, token, peer.name, self._rng.getrandbits(64), own.encode(), offer)


def seal(sealing: SealingKeys, header: Header, plain: bytes) -> bytes:
    """Return a datagram sealed with these keys."""
    clear = frame.encode_header(header)
    out = bytearray(len(plain) + TAG_BYTES)
    sealing.encrypt_into(clear[NONCE_OFFSET:HEADER_BYTES], plain, clear, out)
    return clear + out
