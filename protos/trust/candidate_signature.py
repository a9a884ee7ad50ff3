"""Signs the addresses that a sidecar announces with its certificate's key, so that a control plane cannot add any.

Every announcement of a session has a larger serial than the one before. The signature (ECDSA P-256 with SHA-256, DER)
covers this, big-endian, with texts in ASCII as in the model::

    "plr candidates" | 0 (8) | session (64) | serial (64) | number of candidates (16)
    for each: interface's number (8) | kind (8): 1 host, 2 seen by STUN | port (16)
              length (8) | interface's name | length (8) | IP address

The session's number follows from its owner's name, role and key (`credential.py`), so nobody else's session can be
signed for. These bytes are never parsed: the verifier builds them from the candidates it received.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from cryptography.exceptions import InvalidSignature

from plr.protos.model.members import CandidateKind
from plr.protos.trust.credential import SIGNATURE_ALGORITHM, signer_key
from plr.protos.trust.identity import UNTRUSTED, CertificateError

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric import ec

    from plr.protos.model.ids import SessionId
    from plr.protos.model.members import Candidate

_LABEL = b"plr candidates\0"
_HEAD = struct.Struct(">QQH")
_CANDIDATE = struct.Struct(">BBH")
_KINDS = {CandidateKind.HOST: 1, CandidateKind.SERVER_REFLEXIVE: 2}


def sign_candidates(
    private_key: ec.EllipticCurvePrivateKey, session: SessionId, serial: int, candidates: tuple[Candidate, ...]
) -> bytes:
    """Return the signature, at most `MAX_SIGNATURE_BYTES`."""
    return private_key.sign(signed_bytes(session, serial, candidates), SIGNATURE_ALGORITHM)


def verify_candidates(
    certificate: bytes, session: SessionId, serial: int, candidates: tuple[Candidate, ...], signature: bytes
) -> None:
    """Check the signature with the certificate (DER) of the session's credential, which the caller has to judge.

    Raises:
        CertificateError: the certificate's key did not sign this.
    """
    if not signature:
        raise CertificateError(UNTRUSTED, "its addresses are not signed")
    try:
        signer_key(certificate).verify(signature, signed_bytes(session, serial, candidates), SIGNATURE_ALGORITHM)
    except InvalidSignature:
        raise CertificateError(UNTRUSTED, "the signature of its addresses is wrong") from None


def signed_bytes(session: SessionId, serial: int, candidates: tuple[Candidate, ...]) -> bytes:
    """Return the bytes to sign; different candidates give different bytes."""
    parts = [_LABEL, _HEAD.pack(session, serial, len(candidates))]
    for candidate in candidates:
        host, port = candidate.address
        parts.append(_CANDIDATE.pack(candidate.interface_id, _KINDS[candidate.kind], port))
        # A zone (fe80::1%eth0) means nothing elsewhere and is not transmitted.
        for text in (candidate.interface.encode(), host.partition("%")[0].encode()):
            parts += (bytes([len(text)]), text)
    return b"".join(parts)
