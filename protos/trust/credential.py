"""Encodes what a run of a sidecar says about itself, signed with its certificate's key: peers need trust nobody else.

The control plane relays it as opaque bytes, so it cannot substitute another key. Layout, big-endian::

    format (8) = 1 | role (8): 1 robot, 2 cloud | AEAD (8): 1 AES-256-GCM, 2 ChaCha20-Poly1305 | length of name (8)
    session (64) | incarnation (64) | X25519 public key (32 bytes) | length of certificate (16)
    name | certificate (DER; none in insecure mode)
    length of signature (8) | signature (ECDSA P-256 with SHA-256, DER, over a label and all that stands before it)

Nothing may follow, so that equal credentials are equal bytes. The session is the first 64 bits of SHA-256 over a label,
the role (8), the length of the name (8), the name and the public key, with 1 in place of 0. So nobody can take another
node's number, although it is in clear in every datagram of that node.
"""

from __future__ import annotations

import enum
import hashlib
import struct
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509 import load_der_x509_certificate

from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import NodeName, Role, SessionId
from plr.protos.model.members import MAX_CREDENTIAL_BYTES
from plr.protos.model.names import node_name
from plr.protos.trust.identity import MALFORMED, UNTRUSTED, WRONG_ROLE, CertificateError, Identity, IdentityRole

if TYPE_CHECKING:
    from collections.abc import Callable

PUBLIC_KEY_BYTES = 32
"""X25519 (RFC 7748 section 5)."""

_FORMAT = 1
_HEAD = struct.Struct(f">BBBBQQ{PUBLIC_KEY_BYTES}sH")
_LABEL = b"plr session credential\0"
_NUMBER_LABEL = b"plr session number\0"
SIGNATURE_ALGORITHM = ec.ECDSA(hashes.SHA256())


class Aead(enum.Enum):
    """A cipher that seals datagrams; credentials contain the value."""

    AES_256_GCM = 1
    CHACHA20_POLY1305 = 2


_ROLES = {1: Role.ROBOT, 2: Role.CLOUD}
_ROLE_NUMBERS = {role: number for number, role in _ROLES.items()}


@dataclass(frozen=True, slots=True)
class SessionCredential:
    """A session's owner and key. Without certificate and signature it proves nothing (insecure mode)."""

    name: NodeName
    role: Role
    session: SessionId
    incarnation: int
    public_key: bytes
    """X25519, new in every session."""
    aead: Aead
    """Preferred for datagrams to and from this sidecar."""
    certificate: bytes = field(default=b"", repr=False)
    signature: bytes = field(default=b"", repr=False)

    @property
    def identity(self) -> bytes:
        """The agreed part, which stays the same when the credential is signed again with a renewed certificate."""
        return _head(replace(self, certificate=b"")) + self.name.encode()

    def encode(self) -> bytes:
        """Return the bytes to transmit."""
        return self._signed() + bytes([len(self.signature)]) + self.signature

    def sign(self, private_key: ec.EllipticCurvePrivateKey) -> SessionCredential:
        """Return a copy signed with the key of its certificate."""
        return replace(self, signature=private_key.sign(_LABEL + self._signed(), SIGNATURE_ALGORITHM))

    def _signed(self) -> bytes:
        return _head(self) + self.name.encode() + self.certificate


def session_number(name: NodeName, role: Role, public_key: bytes) -> SessionId:
    """Return the number of the session with this X25519 key."""
    whose = bytes([_ROLE_NUMBERS[role], len(name)]) + name.encode()
    digest = hashlib.sha256(_NUMBER_LABEL + whose + public_key).digest()
    return SessionId(int.from_bytes(digest[:8], "big") or 1)


def _head(credential: SessionCredential) -> bytes:
    return _HEAD.pack(
        _FORMAT,
        _ROLE_NUMBERS[credential.role],
        credential.aead.value,
        len(credential.name),
        credential.session,
        credential.incarnation,
        credential.public_key,
        len(credential.certificate),
    )


def decode_credential(data: bytes) -> SessionCredential:
    """Parse a credential without verifying any of it.

    Raises:
        DecodeError: it breaks the layout.
    """
    if len(data) > MAX_CREDENTIAL_BYTES:
        raise DecodeError(f"credential of {len(data)} bytes, more than {MAX_CREDENTIAL_BYTES}")
    if len(data) < _HEAD.size:
        raise DecodeError("credential cut off")
    number, role, aead, name_bytes, session, incarnation, public_key, certificate_bytes = _HEAD.unpack_from(data)
    if number != _FORMAT:
        raise DecodeError(f"credential of format {number}, not {_FORMAT}")
    if role not in _ROLES or aead not in {known.value for known in Aead}:
        raise DecodeError("credential of an unknown role or AEAD")
    if not session:
        raise DecodeError("credential of session 0")
    name_end = _HEAD.size + name_bytes
    certificate_end = name_end + certificate_bytes
    if len(data) <= certificate_end or len(data) != certificate_end + 1 + data[certificate_end]:
        raise DecodeError("credential whose length differs from what it says")
    try:
        name = node_name(data[_HEAD.size : name_end].decode("ascii"), "credential's name")
    except UnicodeDecodeError:
        raise DecodeError("credential's name is not ASCII") from None
    certificate, signature = data[name_end:certificate_end], data[certificate_end + 1 :]
    return SessionCredential(
        name, _ROLES[role], SessionId(session), incarnation, public_key, Aead(aead), certificate, signature
    )


def verify(credential: SessionCredential, check: Callable[[bytes], Identity]) -> Identity:
    """Return whose credential it is. `check` judges the certificate (DER), as `Trust.check` does.

    Raises:
        CertificateError: the certificate is no good, belongs to another name or role, or did not sign this, or the
            session's number does not match its key.
    """
    identity = check(credential.certificate)
    if identity.name != credential.name or identity.role is not IdentityRole(credential.role.value):
        raise CertificateError(
            WRONG_ROLE, f"a certificate of {identity.role.value} {identity.name} signs for another node"
        )
    try:
        signer_key(credential.certificate).verify(
            credential.signature, _LABEL + credential._signed(), SIGNATURE_ALGORITHM
        )
    except InvalidSignature:
        raise CertificateError(UNTRUSTED, "the credential's signature is wrong") from None
    if credential.session != session_number(credential.name, credential.role, credential.public_key):
        raise CertificateError(MALFORMED, "the credential's session number is not that of its key")
    return identity


def signer_key(certificate: bytes) -> ec.EllipticCurvePublicKey:
    """Return the key of a credential's certificate (DER).

    Raises:
        CertificateError: it has no key that can sign.
    """
    try:
        key = load_der_x509_certificate(certificate).public_key()
    except Exception as error:
        # As in identity.py: faults inside DER raise a dozen kinds of errors.
        raise CertificateError(MALFORMED, f"the credential's certificate: {type(error).__name__}") from error
    if not isinstance(key, ec.EllipticCurvePublicKey):
        raise CertificateError(MALFORMED, "the credential's certificate holds no key on P-256")
    return key
