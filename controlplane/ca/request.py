"""Builds and parses a node's certificate request: PKCS #10 with name and role, signed with the key kept on the node.

    subject          CN=robot-7
    public key       ECDSA on P-256
    attributes       one extension request, of one extension:
    subjectAltName   as the certificate's (protos/trust/identity.py)

A request proves that its maker has the key, and nothing else: its name and role are only claims. So the CA takes only
the key from it, and name and role from the operator. A request for more than our certificates hold is refused.
"""

from __future__ import annotations

import base64
import hashlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
from cryptography.x509.oid import NameOID

from plr.controlplane.ca.certificates import alternative_names
from plr.protos.base.errors import DecodeError
from plr.protos.trust.identity import SIGNATURES, name_and_role

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName
    from plr.protos.trust.identity import IdentityRole

REQUEST_FILE = "request.pem"

MAX_CERTIFICATE_REQUEST_BYTES = 4096
"""Longest request, PEM: `plr request` writes some 420 bytes."""

_EXTENSION_REQUEST = "1.2.840.113549.1.9.14"


@dataclass(frozen=True, slots=True)
class CertificateRequest:
    """A parsed request: that the node has the key is checked, its identity is not."""

    name: NodeName
    role: IdentityRole
    key: ec.EllipticCurvePublicKey = field(repr=False)


def fingerprint(key: ec.EllipticCurvePublicKey) -> str:
    """Return the SHA-256 of the SubjectPublicKeyInfo in base64: people compare it, and the CA identifies keys by it."""
    digest = hashlib.sha256(key.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)).digest()
    return "SHA256:" + base64.b64encode(digest).rstrip(b"=").decode()


def build_request(name: str, role: IdentityRole, key: ec.EllipticCurvePrivateKey) -> bytes:
    """Return a request for a certificate of this key, PEM."""
    builder = x509.CertificateSigningRequestBuilder().subject_name(
        x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    )
    builder = builder.add_extension(alternative_names(name, role), critical=False)
    return builder.sign(key, hashes.SHA256(), ecdsa_deterministic=True).public_bytes(Encoding.PEM)


def parse_request(pem: bytes) -> CertificateRequest:
    """Return the parsed request; raises DecodeError, whose text is fit for a terminal."""
    if len(pem) > MAX_CERTIFICATE_REQUEST_BYTES:
        raise DecodeError(f"the request is longer than {MAX_CERTIFICATE_REQUEST_BYTES} bytes")
    try:
        return _checked(x509.load_pem_x509_csr(pem))
    except DecodeError:
        raise
    except Exception as error:
        # As with certificates, there are a dozen kinds of errors, some raised only when a field is first read.
        raise DecodeError(f"the request is malformed: {type(error).__name__}") from error


def _checked(request: x509.CertificateSigningRequest) -> CertificateRequest:
    key = request.public_key()
    if not (isinstance(key, ec.EllipticCurvePublicKey) and isinstance(key.curve, ec.SECP256R1)):
        raise DecodeError(f"the request's key is not an ECDSA key on P-256, but {_kind(key)}")
    if request.signature_algorithm_oid not in SIGNATURES:
        raise DecodeError("the request is not signed with ECDSA and SHA-2")
    if not request.is_signature_valid:
        raise DecodeError("the request is not signed with the key that it names")
    attributes = [each.oid.dotted_string for each in request.attributes]
    if attributes != [_EXTENSION_REQUEST]:
        found = ", ".join(attributes) or "none"
        raise DecodeError(f"the request has the attributes {found}, expected {_EXTENSION_REQUEST} alone")
    extensions = request.extensions
    for extension in extensions:
        if not isinstance(extension.value, x509.SubjectAlternativeName):
            raise DecodeError(f"the request asks for more than a name and role: {_wish(extension)}")
    name, role = name_and_role(extensions, "request")
    if list(request.subject) != [x509.NameAttribute(NameOID.COMMON_NAME, name)]:
        subject = request.subject.rfc4514_string()
        raise DecodeError(f"the request's subject is {subject!a}, expected the name alone: CN={name}")
    # A key has several encodings, such as with the curve's parameters or compressed. Reduce them to one.
    point = key.public_bytes(Encoding.X962, PublicFormat.UncompressedPoint)
    return CertificateRequest(name, role, ec.EllipticCurvePublicKey.from_encoded_point(ec.SECP256R1(), point))


def _kind(key: object) -> str:
    if isinstance(key, rsa.RSAPublicKey):
        return f"RSA of {key.key_size} bits"
    if isinstance(key, ec.EllipticCurvePublicKey):
        return f"one on {key.curve.name}"
    return type(key).__name__.removesuffix("PublicKey")


def _wish(extension: x509.Extension[x509.ExtensionType]) -> str:
    value = extension.value
    if isinstance(value, x509.BasicConstraints) and value.ca:
        return "to be a CA"
    if isinstance(value, x509.UnrecognizedExtension):
        return extension.oid.dotted_string
    return type(value).__name__
