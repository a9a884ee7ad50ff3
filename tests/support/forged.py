"""Certificates that no CA of ours would issue, for tests of those who must refuse them."""

from __future__ import annotations

import datetime
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, ed25519
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

if TYPE_CHECKING:
    from plr.controlplane.ca import Authority

NOW = 1_900_000_000.0
DAY_S = 86_400.0

NODE_USAGE = frozenset({"digital_signature"})
CA_USAGE = frozenset({"key_cert_sign", "crl_sign"})


def uri(text: str) -> x509.GeneralName:
    return x509.UniformResourceIdentifier(text)


@dataclass
class Recipe:
    """A robot's certificate as it should be; a test changes one thing of it."""

    names: list[x509.GeneralName] = field(default_factory=lambda: [uri("plr://robot/robot-1")])
    ca: bool | None = False
    usage: frozenset[str] | None = NODE_USAGE
    purposes: list[x509.ObjectIdentifier] | None = field(default_factory=lambda: [ExtendedKeyUsageOID.CLIENT_AUTH])
    extra: list[x509.UnrecognizedExtension] = field(default_factory=list)
    extra_critical: bool = True
    hash: hashes.HashAlgorithm = field(default_factory=hashes.SHA256)
    key: ec.EllipticCurvePrivateKey | ed25519.Ed25519PrivateKey = field(
        default_factory=lambda: ec.generate_private_key(ec.SECP256R1())
    )

    def sign(self, issuer: x509.Name, key: ec.EllipticCurvePrivateKey) -> x509.Certificate:
        builder = (
            x509.CertificateBuilder()
            .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "robot-1")]))
            .issuer_name(issuer)
            .public_key(self.key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(moment(NOW - DAY_S))
            .not_valid_after(moment(NOW + DAY_S))
        )
        if self.names:
            builder = builder.add_extension(x509.SubjectAlternativeName(self.names), critical=False)
        if self.ca is not None:
            builder = builder.add_extension(x509.BasicConstraints(ca=self.ca, path_length=None), critical=True)
        if self.usage is not None:
            builder = builder.add_extension(key_usage(self.usage), critical=True)
        if self.purposes is not None:
            builder = builder.add_extension(x509.ExtendedKeyUsage(self.purposes), critical=False)
        for extension in self.extra:
            builder = builder.add_extension(extension, critical=self.extra_critical)
        return builder.sign(key, self.hash)  # type: ignore[arg-type]  # also with the hashes that must be refused

    def der(self, authority: Authority) -> bytes:
        """Let this CA sign it."""
        return self.sign(authority.own.certificate.subject, authority.own.key).public_bytes(Encoding.DER)


def key_usage(names: frozenset[str]) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature="digital_signature" in names,
        content_commitment=False,
        key_encipherment="key_encipherment" in names,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign="key_cert_sign" in names,
        crl_sign="crl_sign" in names,
        encipher_only=False,
        decipher_only=False,
    )


def moment(seconds: float) -> datetime.datetime:
    return datetime.datetime.fromtimestamp(seconds, datetime.UTC)
