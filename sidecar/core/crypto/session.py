"""Holds this run's own key and credential, and judges the peers' credentials."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey

from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import SessionId
from plr.protos.model.members import Candidate
from plr.protos.trust.candidate_signature import verify_candidates
from plr.protos.trust.credential import SessionCredential, decode_credential
from plr.protos.trust.identity import CertificateError
from plr.sidecar.core.crypto.key_schedule import pair_keys

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.protos.model.members import Peer
    from plr.sidecar.core.crypto.key_schedule import PairKeys

MAX_ADMITTED = 8192
"""Credentials, and signed lists of addresses, whose verification is remembered; beyond it all are verified again."""
MAX_CONDEMNED = 1024
"""Sessions refused for what they did; the oldest are forgotten."""

_Announcement = tuple[bytes, SessionId, int, tuple[Candidate, ...], bytes]
"""Certificate, session, serial, candidates, signature."""


def public_key(private_key: bytes) -> bytes:
    """Return the public key of a private one (32 random bytes)."""
    return X25519PrivateKey.from_private_bytes(private_key).public_key().public_bytes_raw()


class OwnSession:
    """Our identity in this run. Any thread may use it: what is remembered is only ever added to, or dropped."""

    def __init__(
        self, credential: SessionCredential, private_key: bytes, verify: Callable[[SessionCredential], float]
    ) -> None:
        """Create the session; `private_key` belongs to the credential's public key.

        `verify` raises DecodeError for a bad credential, and returns when a good one ends (seconds since 1970).
        """
        self.credential = credential
        self._private_key = X25519PrivateKey.from_private_bytes(private_key)
        self._verify = verify
        self._admitted: dict[bytes, tuple[PairKeys, float]] = {}
        """The keys shared under each credential, and when it ends."""
        self._condemned: dict[SessionId, None] = {}
        self._announced: dict[_Announcement, str] = {}
        """The fault of each announcement's signature; it does not depend on whom we trust."""

    def admit(self, peer: Peer) -> PairKeys:
        """Judge a peer's credential and return the keys we share: about 0.3 ms, nothing if it is known.

        Raises:
            DecodeError: the credential is malformed, not of this peer, or refused by `verify`; the text says why.
        """
        if peer.session in self._condemned:
            raise DecodeError("it acknowledged datagrams that were never sent: it is refused until it restarts")
        known = self._admitted.get(peer.credential)
        theirs = decode_credential(peer.credential)
        if (theirs.name, theirs.role, theirs.session, theirs.incarnation) != (
            peer.name, peer.role, peer.session, peer.incarnation,
        ):  # fmt: skip
            raise DecodeError("the credential belongs to another node or session")
        if known is not None:
            return known[0]
        if (theirs.name, theirs.role) == (self.credential.name, self.credential.role):
            raise DecodeError("the credential belongs to a node with our own name and role")
        ends_at = self._verify(theirs)
        try:
            their_key = X25519PublicKey.from_public_bytes(theirs.public_key)
            keys = pair_keys(self._private_key, their_key, self.credential, theirs)
        except ValueError:  # a point of small order (RFC 7748 section 6.1)
            raise DecodeError("the credential's public key has small order") from None
        if len(self._admitted) >= MAX_ADMITTED:
            self._admitted.clear()
        self._admitted[peer.credential] = keys, ends_at
        return keys

    def condemn(self, session: SessionId) -> None:
        """Refuse this session from now on, whatever its credential."""
        self._condemned[session] = None
        if len(self._condemned) > MAX_CONDEMNED:
            self._condemned.pop(next(iter(self._condemned)), None)

    def check_candidates(self, peer: Peer) -> bool:
        """Judge a peer's announced addresses: about 0.1 ms, nothing if they are known.

        Returns whether they are signed: in insecure mode nobody signs.

        Raises:
            DecodeError: the credential is bad, or its certificate did not sign these in its session.
        """
        self.admit(peer)
        certificate = decode_credential(peer.credential).certificate
        if not certificate:
            return False  # otherwise `admit` would have refused it
        said = certificate, peer.session, peer.candidates_serial, peer.candidates, peer.candidates_signature
        fault = self._announced.get(said)
        if fault is None:
            if len(self._announced) >= MAX_ADMITTED:
                self._announced.clear()
            fault = self._announced[said] = _fault(*said)
        if fault:
            raise DecodeError(fault)
        return True

    def has_admitted(self, credential: bytes) -> bool:
        """Return whether this credential was judged good: admitting it again costs nothing."""
        return credential in self._admitted

    def ends_at(self, credential: bytes) -> float:
        """Return when an admitted credential ends (seconds since 1970); minus infinity for any other."""
        known = self._admitted.get(credential)
        return -math.inf if known is None else known[1]

    def forget_ended(self, now_wall: float) -> bool:
        """Forget credentials that ended by now (seconds since 1970), to judge them again; False if there are none."""
        ended = [credential for credential, (_, ends_at) in list(self._admitted.items()) if ends_at < now_wall]
        for credential in ended:
            self._admitted.pop(credential, None)
        return bool(ended)

    def renew(self, credential: SessionCredential) -> None:
        """Take the same credential signed again, with a renewed certificate.

        Raises:
            ValueError: it belongs to another session.
        """
        if credential.identity != self.credential.identity:
            raise ValueError("the credential belongs to another session")
        self.credential = credential

    def forget_admitted(self) -> None:
        """Forget all judgements, since whom to trust has changed: each credential is judged again when next seen."""
        self._admitted.clear()


def _fault(
    certificate: bytes, session: SessionId, serial: int, candidates: tuple[Candidate, ...], signature: bytes
) -> str:
    try:
        verify_candidates(certificate, session, serial, candidates, signature)
    except CertificateError as error:
        return str(error)
    return ""
