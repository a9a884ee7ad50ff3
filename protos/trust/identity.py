"""Establishes who a node is: X.509 certificates of the fleet's CA, and whether to believe one.

The CA issues leaf certificates directly. The only URI among the alternative names holds name and role:

    subjectAltName = URI:plr://robot/robot-1                                        a node, or an operator
    subjectAltName = URI:plr://controlplane/cp-1, DNS:controlplane.plr.internal     the control plane

Keys are ECDSA on P-256, since gRPC's TLS accepts no Ed25519. A certificate must follow RFC 5280's profile of an end
entity, narrowed to what the CA issues: one that says more than a node's does is refused. Pure: the time is passed in,
nothing is read.
"""

from __future__ import annotations

import enum
import hashlib
import math
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import ExtendedKeyUsageOID, SignatureAlgorithmOID

from plr.protos.base.durations import in_words
from plr.protos.base.errors import DecodeError
from plr.protos.model.names import node_name

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName

CONTROL_PLANE_DNS = "controlplane.plr.internal"
"""The name that every client requires in the control plane's certificate, whatever address it was reached at."""

URI_SCHEME = "plr"

MAX_CERTIFICATE_BYTES = 1536
"""Longest certificate in DER; one issued by the CA has some 500 bytes."""

MAX_CA_CERTIFICATES = 16
"""CAs trusted at once; a rotation needs two."""

MAX_REVOCATION_LISTS = 64
"""Lists in one file or message: one per CA; each may cost a signature check."""

MALFORMED = "malformed"
UNTRUSTED = "untrusted"
EXPIRED = "expired"
NOT_YET_VALID = "not_yet_valid"
WRONG_ROLE = "wrong_role"
REVOKED = "revoked"
LIST_TOO_OLD = "list_too_old"

SIGNATURES = frozenset(
    {
        SignatureAlgorithmOID.ECDSA_WITH_SHA256,
        SignatureAlgorithmOID.ECDSA_WITH_SHA384,
        SignatureAlgorithmOID.ECDSA_WITH_SHA512,
    }
)
_PEM_CRL = re.compile(rb"-----BEGIN X509 CRL-----.*?-----END X509 CRL-----", re.DOTALL)


class IdentityRole(enum.Enum):
    """What a certificate entitles its owner to."""

    ROBOT = "robot"
    CLOUD = "cloud"
    CONTROL_PLANE = "controlplane"
    OPERATOR = "operator"


_ROLES = {role.value: role for role in IdentityRole}


class CertificateError(DecodeError):
    """A certificate is refused; `reason` is one of the words above (malformed, untrusted, ...)."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


@dataclass(frozen=True, slots=True)
class Identity:
    """The owner of a certificate and its validity (seconds since 1970, both ends included; never beyond its CA's)."""

    name: NodeName
    role: IdentityRole
    serial: int
    not_before: float
    not_after: float


def identity_uri(name: str, role: IdentityRole) -> str:
    """Return the alternative name that represents a name and role."""
    return f"{URI_SCHEME}://{role.value}/{name}"


@dataclass(frozen=True, slots=True)
class RevocationList:
    """A list as its CA signed it; times are seconds since 1970."""

    number: int
    signed_at: float
    next_at: float
    """When the CA plans the next list; the lists of `plr ca` name the end of the CA itself."""
    pem: bytes = field(repr=False)


@dataclass(slots=True)
class _Authority:
    certificate: x509.Certificate
    key: ec.EllipticCurvePublicKey
    newest: RevocationList | None = None
    revoked: set[int] = field(default_factory=set)

    @property
    def crl_number(self) -> int:
        """Number of the newest list; -1 if there is none."""
        return -1 if self.newest is None else self.newest.number

    def digest(self) -> int:
        """Return 64 bits that represent the CA."""
        return int.from_bytes(hashlib.sha256(self.certificate.public_bytes(Encoding.DER)).digest()[:8], "big")


class Trust:
    """The CAs to believe and what they have revoked.

    `ca_certificates` is PEM, with one CA, or several while one replaces another. `crl` is PEM, with one or more lists.
    Lists of CAs that are not (or no longer) believed are ignored, but at least one must be of these CAs. A list does
    not age: the last one is valid until there is a newer one. Raises CertificateError if either argument is wrong.
    """

    def __init__(self, ca_certificates: bytes, crl: bytes | None = None) -> None:
        self._authorities = _load_authorities(ca_certificates)
        if crl is not None:
            _load_revocations(crl, self._authorities)

    def forgets(self, other: Trust) -> bool:
        """Return whether a list of `other` is missing or older here: what is revoked there may count as good here."""
        numbers = {authority.certificate: authority.crl_number for authority in self._authorities}
        return any(
            numbers.get(authority.certificate, authority.crl_number) < authority.crl_number
            for authority in other._authorities
        )

    def with_revocations(self, pem: bytes) -> Trust:
        """Return a copy with further lists; whatever was revoked stays revoked. Raises like the constructor."""
        wider = Trust.__new__(Trust)
        wider._authorities = tuple(
            _Authority(authority.certificate, authority.key, authority.newest, set(authority.revoked))
            for authority in self._authorities
        )
        _load_revocations(pem, wider._authorities)
        return wider

    def lists(self) -> dict[int, RevocationList | None]:
        """Return each CA's newest list, by 64 bits of the CA's digest."""
        return {authority.digest(): authority.newest for authority in self._authorities}

    def crl_pem(self) -> bytes:
        """Return the newest list of each CA in PEM; empty if there is none."""
        return b"".join(authority.newest.pem for authority in self._authorities if authority.newest is not None)

    def too_old(self, now_wall: float, max_age_s: float) -> frozenset[int]:
        """Return the CAs (digests) without a list signed in the last `max_age_s`."""
        return frozenset(
            authority.digest() for authority in self._authorities if _list_age_s(authority, now_wall) > max_age_s
        )

    def revokes(self, serial: int) -> bool:
        """Return whether any list has this serial number; a quick check, which may hit another CA's certificate."""
        return any(serial in authority.revoked for authority in self._authorities)

    def identify(self, certificate_der: bytes) -> Identity:
        """Return whom a certificate of these CAs names, regardless of age and revocation; raise CertificateError."""
        return self._identify(certificate_der)[0]

    def check(self, certificate_der: bytes, now_wall: float, max_list_age_s: float = math.inf) -> Identity:
        """Return whom a certificate names if it is good at `now_wall` (seconds since 1970), or raise CertificateError.

        It is not good either if its CA is not known to have signed a list in the last `max_list_age_s`.
        """
        identity, issuer = self._identify(certificate_der)
        if identity.serial in issuer.revoked:
            raise CertificateError(REVOKED, f"the certificate of {identity.name} is revoked")
        age_s = _list_age_s(issuer, now_wall)
        if age_s > max_list_age_s:
            known = "is not here" if math.isinf(age_s) else f"was signed {age_s:.0f} s ago by this clock"
            raise CertificateError(
                LIST_TOO_OLD, f"its CA's revocation list {known}, max_revocation_age_s is {max_list_age_s:.0f}"
            )
        _check_time(*_validity(issuer.certificate), now_wall, "the CA's certificate")
        _check_time(identity.not_before, identity.not_after, now_wall, f"the certificate of {identity.name}")
        return identity

    def _identify(self, certificate_der: bytes) -> tuple[Identity, _Authority]:
        if len(certificate_der) > MAX_CERTIFICATE_BYTES:
            raise CertificateError(MALFORMED, f"the certificate is longer than {MAX_CERTIFICATE_BYTES} bytes")
        try:
            certificate = x509.load_der_x509_certificate(certificate_der)
            _check_leaf(certificate)
            name, role = name_and_role(certificate.extensions, "certificate")
            begin, end = _validity(certificate)
        except CertificateError:
            raise
        except Exception as error:
            # Faults inside DER raise a dozen kinds of errors, some only when a field is first accessed.
            raise CertificateError(MALFORMED, f"the certificate is malformed: {type(error).__name__}") from error
        issuer = self._issuer(certificate)
        end = min(end, _validity(issuer.certificate)[1])
        return Identity(name, role, certificate.serial_number, begin, end), issuer

    def _issuer(self, certificate: x509.Certificate) -> _Authority:
        for authority in self._authorities:
            # CAs of the same name are distinguished by their signature.
            try:
                certificate.verify_directly_issued_by(authority.certificate)
            except (ValueError, TypeError, InvalidSignature):
                continue
            return authority
        raise CertificateError(UNTRUSTED, "the certificate is issued by another CA")


def _load_authorities(pem: bytes) -> tuple[_Authority, ...]:
    try:
        certificates = x509.load_pem_x509_certificates(pem)
        if len(certificates) > MAX_CA_CERTIFICATES:
            raise CertificateError(MALFORMED, f"more than {MAX_CA_CERTIFICATES} CAs")
        return tuple(_authority(certificate) for certificate in certificates)
    except CertificateError:
        raise
    except Exception as error:
        raise CertificateError(MALFORMED, f"the CA's certificate is malformed: {type(error).__name__}") from error


def _authority(certificate: x509.Certificate) -> _Authority:
    extensions = certificate.extensions
    key = certificate.public_key()
    if not extensions.get_extension_for_class(x509.BasicConstraints).value.ca:
        raise CertificateError(MALFORMED, "the CA's certificate is not a CA certificate")
    usage = extensions.get_extension_for_class(x509.KeyUsage).value
    if not (usage.key_cert_sign and usage.crl_sign):
        raise CertificateError(MALFORMED, "the CA's key may not sign certificates and revocation lists")
    if not isinstance(key, ec.EllipticCurvePublicKey):
        raise CertificateError(MALFORMED, "the CA's key is not an ECDSA key")
    return _Authority(certificate, key)


def _list_age_s(authority: _Authority, now_wall: float) -> float:
    return math.inf if authority.newest is None else now_wall - authority.newest.signed_at


def _load_revocations(pem: bytes, authorities: tuple[_Authority, ...]) -> None:
    """Note for each CA the serial numbers that it has revoked."""
    blocks: list[bytes] = _PEM_CRL.findall(pem)
    if not blocks:
        raise CertificateError(MALFORMED, "the revocation list is not PEM")
    if len(blocks) > MAX_REVOCATION_LISTS:
        raise CertificateError(MALFORMED, f"more than {MAX_REVOCATION_LISTS} revocation lists")
    known = False
    for block in blocks:
        try:
            crl = x509.load_pem_x509_crl(block)
            partial = any(extension.critical for extension in crl.extensions)
            number = crl.extensions.get_extension_for_class(x509.CRLNumber).value.crl_number
            signed_at = crl.last_update_utc.timestamp()
            next_at = math.inf if crl.next_update_utc is None else crl.next_update_utc.timestamp()
            serials = {entry.serial_number for entry in crl}
            issuers = [
                authority
                for authority in authorities
                if crl.issuer == authority.certificate.subject and crl.is_signature_valid(authority.key)
            ]
        except Exception as error:
            raise CertificateError(MALFORMED, f"the revocation list is malformed: {type(error).__name__}") from error
        if partial:
            # RFC 5280 section 5.2: a delta list, or one about some certificates only, says so in a critical extension.
            raise CertificateError(MALFORMED, "the revocation list is not a complete one")
        for issuer in issuers:
            if number > issuer.crl_number:
                issuer.newest = RevocationList(number, signed_at, next_at, block + b"\n")
            issuer.revoked.update(serials)
            known = True
    if not known:
        raise CertificateError(UNTRUSTED, "the revocation list is issued by another CA")


def _check_leaf(certificate: x509.Certificate) -> None:
    """Check what a certificate contains besides names and times."""
    key = certificate.public_key()
    if not (isinstance(key, ec.EllipticCurvePublicKey) and isinstance(key.curve, ec.SECP256R1)):
        raise CertificateError(MALFORMED, "the certificate's key is not an ECDSA key on P-256")
    if certificate.signature_algorithm_oid not in SIGNATURES:
        raise CertificateError(MALFORMED, "the certificate is not signed with ECDSA and SHA-2")
    extensions = certificate.extensions
    known = (x509.BasicConstraints, x509.KeyUsage, x509.ExtendedKeyUsage, x509.SubjectAlternativeName)
    if any(extension.critical and not isinstance(extension.value, known) for extension in extensions):
        raise CertificateError(MALFORMED, "the certificate has a critical extension of unknown meaning")
    if extensions.get_extension_for_class(x509.BasicConstraints).value.ca:
        raise CertificateError(MALFORMED, "the certificate is a CA certificate, not a node's")
    usage = extensions.get_extension_for_class(x509.KeyUsage).value
    if not usage.digital_signature or usage.key_cert_sign or usage.crl_sign:
        raise CertificateError(MALFORMED, "the certificate's key usage is not a node's")
    if ExtendedKeyUsageOID.CLIENT_AUTH not in extensions.get_extension_for_class(x509.ExtendedKeyUsage).value:
        raise CertificateError(MALFORMED, "the certificate is not for TLS clients")


def name_and_role(extensions: x509.Extensions, what: str) -> tuple[NodeName, IdentityRole]:
    """Return whom a certificate or a request names; raise CertificateError, whose text calls it `what`."""
    names = list(extensions.get_extension_for_class(x509.SubjectAlternativeName).value)
    uris = [name.value for name in names if isinstance(name, x509.UniformResourceIdentifier)]
    others = [name for name in names if not isinstance(name, x509.UniformResourceIdentifier)]
    if len(uris) != 1:
        raise CertificateError(MALFORMED, f"the {what} has {len(uris)} URIs, expected one")
    scheme, _, rest = uris[0].partition("://")
    role_text, _, name_text = rest.partition("/")
    if scheme != URI_SCHEME:
        raise CertificateError(MALFORMED, f"the {what}'s URI is not {URI_SCHEME}://role/name")
    role = _ROLES.get(role_text)
    if role is None:
        raise CertificateError(WRONG_ROLE, f"the {what}'s role {role_text!a} is unknown")
    try:
        name = node_name(name_text, f"the {what}'s name")
    except DecodeError as error:
        raise CertificateError(MALFORMED, str(error)) from error
    expected = [x509.DNSName(CONTROL_PLANE_DNS)] if role is IdentityRole.CONTROL_PLANE else []
    if others != expected:
        raise CertificateError(MALFORMED, f"the {what} has alternative names that a {role.value} must not have")
    return name, role


def _validity(certificate: x509.Certificate) -> tuple[float, float]:
    return certificate.not_valid_before_utc.timestamp(), certificate.not_valid_after_utc.timestamp()


def _check_time(not_before: float, not_after: float, now_wall: float, what: str) -> None:
    if now_wall < not_before:
        raise CertificateError(NOT_YET_VALID, f"{what} is not valid for another {in_words(not_before - now_wall)}")
    if now_wall > not_after:
        raise CertificateError(EXPIRED, f"{what} expired {in_words(now_wall - not_after)} ago")
