"""From two sessions' keys to the keys of each path and direction. Every step is HKDF with SHA-256 (RFC 5869)::

    pair secret  = HKDF(salt "plr 2 pair", X25519(own key, peer's key), identity of the first | of the second)
    path secret  = Expand(pair secret, "plr 2 path" | sender's interface (8) | receiver's interface (8) | direction (8))
    key          = Expand(secret of the phase, "plr 2 key")
    next secret  = Expand(secret of the phase, "plr 2 next phase")

An identity is name, role, session, incarnation, public key and AEAD, as `SessionCredential.identity` lays them out, its
length (16) before it; role and name put the two in order. Direction is 0 when the first of them sends. So a key belongs
to one pair of runs, one pair of interfaces, one direction and one phase, and both ends agree on all of these or on
nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF, HKDFExpand

from sidecar.core.aead import KEY_BYTES, choose

if TYPE_CHECKING:
    from protos.credential import Aead, SessionCredential
    from protos.model import InterfaceId

_PAIR = b"plr 2 pair"
_PATH = b"plr 2 path"
_KEY = b"plr 2 key"
_NEXT = b"plr 2 next phase"


@dataclass(frozen=True, slots=True)
class PairKeys:
    """What two sessions share."""

    secret: bytes = field(repr=False)
    aead: Aead
    first: bool
    """Whether we stand first in the order of role and name."""

    def sending(self, ours: InterfaceId, theirs: InterfaceId) -> bytes:
        """Return the secret of the first phase of what we send over this path."""
        return self._path_secret(ours, theirs, 0 if self.first else 1)

    def receiving(self, ours: InterfaceId, theirs: InterfaceId) -> bytes:
        """Return the secret of the first phase of what they send over this path."""
        return self._path_secret(theirs, ours, 1 if self.first else 0)

    def _path_secret(self, sender: InterfaceId, receiver: InterfaceId, direction: int) -> bytes:
        return expand(self.secret, _PATH + bytes((sender, receiver, direction)))


def pair_keys(shared: bytes, ours: SessionCredential, theirs: SessionCredential) -> PairKeys:
    """Return what two sessions share; `shared` is the result of X25519."""
    first = _order(ours) < _order(theirs)
    in_order = (ours, theirs) if first else (theirs, ours)
    info = b"".join(len(one.identity).to_bytes(2, "big") + one.identity for one in in_order)
    secret = HKDF(SHA256(), KEY_BYTES, salt=_PAIR, info=info).derive(shared)
    return PairKeys(secret, choose(ours.aead, theirs.aead), first)


def phase_key(secret: bytes) -> bytes:
    """Return the key of the phase with this secret."""
    return expand(secret, _KEY)


def next_phase(secret: bytes) -> bytes:
    """Return the secret of the phase after the one with this secret."""
    return expand(secret, _NEXT)


def expand(secret: bytes, info: bytes, size: int = KEY_BYTES) -> bytes:
    """HKDF-Expand (RFC 5869 section 2.3)."""
    return HKDFExpand(SHA256(), size, info).derive(secret)


def _order(credential: SessionCredential) -> tuple[str, str]:
    return credential.role.value, credential.name
