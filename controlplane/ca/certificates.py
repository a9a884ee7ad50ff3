"""Builds the X.509 structures that a CA signs: its own certificate, those of nodes, and its revocation list.

Signatures are deterministic (RFC 6979): the safety of the CA's key does not depend on good randomness in every
signature, and an unchanged revocation list has the same bytes. `plr.protos.trust.identity` checks what is built here.
"""

from __future__ import annotations

import datetime
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from plr.controlplane.ca.key_file import clear_pem
from plr.protos.trust.identity import CONTROL_PLANE_DNS, IdentityRole, identity_uri

if TYPE_CHECKING:
    from collections.abc import Iterable

_HASH = hashes.SHA256()


@dataclass(frozen=True, slots=True)
class Validity:
    """Validity period of a certificate in seconds since 1970; both ends are rounded down to whole seconds."""

    not_before: float
    not_after: float


@dataclass(frozen=True, slots=True)
class Issued:
    """A node's certificate and key."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey = field(repr=False)

    @property
    def certificate_pem(self) -> bytes:
        """The certificate in PEM."""
        return self.certificate.public_bytes(Encoding.PEM)

    @property
    def certificate_der(self) -> bytes:
        """The certificate in DER."""
        return self.certificate.public_bytes(Encoding.DER)

    @property
    def key_pem(self) -> bytes:
        """The private key in PEM, unencrypted."""
        return clear_pem(self.key)


def generate_key() -> ec.EllipticCurvePrivateKey:
    """Make a private key on P-256, the curve that gRPC's TLS accepts."""
    return ec.generate_private_key(ec.SECP256R1())


def build_authority(name: str, key: ec.EllipticCurvePrivateKey, validity: Validity) -> x509.Certificate:
    """Return the self-signed certificate of a CA that may issue to nodes but create no further CA."""
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    builder = _builder(subject, subject, key.public_key(), validity)
    builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
    builder = builder.add_extension(_key_usage(authority=True), critical=True)
    return _with_key_ids(builder, key.public_key(), key.public_key()).sign(key, _HASH, ecdsa_deterministic=True)


def build_leaf(
    issuer: Issued, name: str, role: IdentityRole, key: ec.EllipticCurvePublicKey, validity: Validity
) -> x509.Certificate:
    """Return the certificate of a node."""
    purposes = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if role is IdentityRole.CONTROL_PLANE:
        purposes.append(ExtendedKeyUsageOID.SERVER_AUTH)
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    builder = _builder(subject, issuer.certificate.subject, key, validity)
    builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
    builder = builder.add_extension(_key_usage(authority=False), critical=True)
    builder = builder.add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
    builder = builder.add_extension(alternative_names(name, role), critical=False)
    return _with_key_ids(builder, key, issuer.key.public_key()).sign(issuer.key, _HASH, ecdsa_deterministic=True)


def alternative_names(name: str, role: IdentityRole) -> x509.SubjectAlternativeName:
    """Return the extension that holds name and role."""
    names: list[x509.GeneralName] = [x509.UniformResourceIdentifier(identity_uri(name, role))]
    if role is IdentityRole.CONTROL_PLANE:
        names.append(x509.DNSName(CONTROL_PLANE_DNS))
    return x509.SubjectAlternativeName(names)


def build_revocation_list(
    issuer: Issued, number: int, revoked: Iterable[tuple[int, float, str]], validity: Validity
) -> x509.CertificateRevocationList:
    """Return the signed list of revoked certificates; `revoked` holds (serial number, time of revocation, reason)."""
    builder = (
        x509.CertificateRevocationListBuilder()
        .issuer_name(issuer.certificate.subject)
        .last_update(_time(validity.not_before))
        .next_update(_time(validity.not_after))
        .add_extension(x509.CRLNumber(number), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(issuer.key.public_key()), critical=False)
    )
    for serial, revoked_at, reason in revoked:
        entry = x509.RevokedCertificateBuilder().serial_number(serial).revocation_date(_time(revoked_at))
        flag = x509.ReasonFlags(reason)
        if flag is not x509.ReasonFlags.unspecified:
            # RFC 5280 section 5.3.1: an unspecified reason is expressed by omitting the extension.
            entry = entry.add_extension(x509.CRLReason(flag), critical=False)
        builder = builder.add_revoked_certificate(entry.build())
    return builder.sign(issuer.key, _HASH, ecdsa_deterministic=True)


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, validity: Validity
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(_time(validity.not_before))
        .not_valid_after(_time(validity.not_after))
    )


def _with_key_ids(
    builder: x509.CertificateBuilder, own: ec.EllipticCurvePublicKey, issuer: ec.EllipticCurvePublicKey
) -> x509.CertificateBuilder:
    builder = builder.add_extension(x509.SubjectKeyIdentifier.from_public_key(own), critical=False)
    return builder.add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(issuer), critical=False)


def _key_usage(*, authority: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not authority,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=authority,
        crl_sign=authority,
        encipher_only=False,
        decipher_only=False,
    )


def _time(seconds: float) -> datetime.datetime:
    return datetime.datetime.fromtimestamp(int(seconds), datetime.UTC)
