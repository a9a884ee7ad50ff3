"""Derives the keys of each path and direction from two sessions' keys. Every step is HKDF with SHA-256 (RFC 5869)::

    pair secret  = HKDF(salt "plr 2 pair", X25519(own key, peer's key), identity of the first | of the second)
    root 0       = Expand(pair secret, "plr 3 path" | the first's interface (8) | the second's interface (8))
    root n       = HKDF(salt root n - 1, X25519(e, f) | X25519(e, F) | X25519(E, f), "plr 3 phase" | n (32) | e | f)
    key n        = Expand(root n, "plr 3 key" | direction (8))
    offer n      = Expand(root n - 1, "plr 3 offer" | n (32) | e), the first 16 bytes
    proof n      = Expand(root n, "plr 3 proof"), the first 16 bytes

An identity is name, role, session, incarnation, public key and AEAD, as `SessionCredential.identity` lays them out, its
length (16) before it; role and name put the two in order. Direction is 0 when the first of them sends. E and F are the
sessions' keys of the end that leads (the robot) and of the other one; e and f are new ones for each phase, whose
private halves are forgotten with the exchange (key_exchange.py). So a key belongs to one pair of runs, one pair of
interfaces, one direction and one phase, and both ends agree on all of these or on nothing. All keys of today open
nothing of an earlier phase. One end's session key is not enough to impersonate the other end to it: that takes the
other's session key as well, as in the Noise pattern IK.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF, HKDFExpand

from plr.sidecar.core.crypto.aead import KEY_BYTES, choose

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey

    from plr.protos.model.ids import InterfaceId
    from plr.protos.trust.credential import Aead, SessionCredential

_PAIR = b"plr 2 pair"
_PATH = b"plr 3 path"
_PHASE = b"plr 3 phase"
_KEY = b"plr 3 key"
_OFFER = b"plr 3 offer"
_PROOF = b"plr 3 proof"
PROOF_BYTES = 16


@dataclass(frozen=True, slots=True)
class PairKeys:
    """What two sessions share."""

    secret: bytes = field(repr=False)
    aead: Aead
    first: bool
    """Whether we come first in the order of role and name."""
    own: X25519PrivateKey = field(repr=False)
    """Our session's key."""
    theirs: X25519PublicKey = field(repr=False)
    """Their session's key."""

    def root(self, ours: InterfaceId, theirs: InterfaceId) -> bytes:
        """Return the root of the first phase of the path between these interfaces."""
        in_order = (ours, theirs) if self.first else (theirs, ours)
        return expand(self.secret, _PATH + bytes(in_order))

    def sealing_key(self, root: bytes) -> bytes:
        """Return the key of what we send under a root."""
        return expand(root, _KEY + bytes([0 if self.first else 1]))

    def opening_key(self, root: bytes) -> bytes:
        """Return the key of what they send under a root."""
        return expand(root, _KEY + bytes([1 if self.first else 0]))


def pair_keys(
    own: X25519PrivateKey, theirs: X25519PublicKey, ours: SessionCredential, credential: SessionCredential
) -> PairKeys:
    """Return what two sessions share; raises ValueError if their key is of small order (RFC 7748 section 6.1)."""
    first = _order(ours) < _order(credential)
    in_order = (ours, credential) if first else (credential, ours)
    info = b"".join(len(one.identity).to_bytes(2, "big") + one.identity for one in in_order)
    secret = HKDF(SHA256(), KEY_BYTES, salt=_PAIR, info=info).derive(own.exchange(theirs))
    return PairKeys(secret, choose(ours.aead, credential.aead), first, own, theirs)


def next_root(root: bytes, shared: bytes, phase: int, leading: bytes, following: bytes) -> bytes:
    """Return the root of a phase: `shared` is the result of the three exchanges, the others are the new public keys."""
    info = _PHASE + phase.to_bytes(4, "big") + leading + following
    return HKDF(SHA256(), KEY_BYTES, salt=root, info=info).derive(shared)


def proof_of_offer(root: bytes, phase: int, leading: bytes) -> bytes:
    """Return the proof of a new key for the next phase; it takes the current root to make."""
    return expand(root, _OFFER + phase.to_bytes(4, "big") + leading, PROOF_BYTES)


def proof(root: bytes) -> bytes:
    """Return the proof of knowing a root."""
    return expand(root, _PROOF, PROOF_BYTES)


def expand(secret: bytes, info: bytes, size: int = KEY_BYTES) -> bytes:
    """Expand a secret with HKDF-Expand (RFC 5869 section 2.3)."""
    return HKDFExpand(SHA256(), size, info).derive(secret)


def _order(credential: SessionCredential) -> tuple[str, str]:
    return credential.role.value, credential.name
