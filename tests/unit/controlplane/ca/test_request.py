"""Requests for certificates: what a node writes is read, and what else is written is refused with its reason."""

from __future__ import annotations

import shutil
import subprocess
from typing import TYPE_CHECKING

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import AttributeOID, ExtendedKeyUsageOID, NameOID

from plr.controlplane.ca.certificates import alternative_names, generate_key
from plr.controlplane.ca.key_file import clear_pem
from plr.controlplane.ca.request import MAX_CERTIFICATE_REQUEST_BYTES, build_request, fingerprint, parse_request
from plr.protos.base.errors import DecodeError
from plr.protos.trust.identity import CONTROL_PLANE_DNS, IdentityRole

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.audit("sec-11")

KEY = generate_key()
ROBOT = "plr://robot/robot-1"

RSA_512 = b"""-----BEGIN CERTIFICATE REQUEST-----
MIH9MIGoAgEAMBIxEDAOBgNVBAMMB3JvYm90LTcwXDANBgkqhkiG9w0BAQEFAANL
ADBIAkEAru5U2afN3HiGWylpxGMf5IGKAFmgXInzpESZsvL4ceRbp9rOyh5tiJC5
mN6y0l3kXlOG2isMMdDM41xcGNlA+QIDAQABoDEwLwYJKoZIhvcNAQkOMSIwIDAe
BgNVHREEFzAVhhNwbHI6Ly9yb2JvdC9yb2JvdC03MA0GCSqGSIb3DQEBCwUAA0EA
WaMmAj6jEQiHmJ/XzUQFlR+jghDSLA+krpBk+j3Eco4WHuM6X6GeTV6q56XZtLA8
uJOFJw15WBv/4vBv8v9kaQ==
-----END CERTIFICATE REQUEST-----
"""
"""The library makes no such keys any more."""


def builder(
    *names: x509.GeneralName, subject: list[x509.NameAttribute[str]] | None = None
) -> x509.CertificateSigningRequestBuilder:
    own = [x509.NameAttribute(NameOID.COMMON_NAME, "robot-1")]
    made = x509.CertificateSigningRequestBuilder().subject_name(x509.Name(own if subject is None else subject))
    return made.add_extension(x509.SubjectAlternativeName(names), critical=False) if names else made


def uri(text: str) -> x509.UniformResourceIdentifier:
    return x509.UniformResourceIdentifier(text)


def signed(
    request: x509.CertificateSigningRequestBuilder,
    key: ec.EllipticCurvePrivateKey | rsa.RSAPrivateKey = KEY,
    digest: hashes.SHA256 | hashes.SHA3_256 | None = None,
) -> bytes:
    return request.sign(key, digest or hashes.SHA256()).public_bytes(Encoding.PEM)


def refusal(pem: bytes) -> str:
    with pytest.raises(DecodeError) as caught:
        parse_request(pem)
    text = str(caught.value)
    assert text.isprintable()
    return text


@pytest.mark.parametrize("role", IdentityRole)
def test_what_a_node_asks_for_is_read(role: IdentityRole) -> None:
    request = parse_request(build_request("node-1", role, KEY))
    assert (request.name, request.role) == ("node-1", role)
    assert fingerprint(request.key) == fingerprint(KEY.public_key())


def test_keys_have_fingerprints_of_their_own() -> None:
    assert fingerprint(KEY.public_key()) != fingerprint(generate_key().public_key())


@pytest.mark.parametrize(
    ("pem", "kind"),
    [
        (RSA_512, "RSA of 512 bits"),
        (signed(builder(uri(ROBOT)), rsa.generate_private_key(65537, 1024)), "RSA of 1024 bits"),
        *(
            (signed(builder(uri(ROBOT)), ec.generate_private_key(curve)), f"one on {curve.name}")
            for curve in (ec.SECP192R1(), ec.SECP384R1(), ec.SECP256K1())
        ),
        (
            builder(uri(ROBOT)).sign(ed25519.Ed25519PrivateKey.generate(), None).public_bytes(Encoding.PEM),
            "Ed25519",
        ),
    ],
)
def test_a_key_of_another_kind_is_refused(pem: bytes, kind: str) -> None:
    assert refusal(pem) == f"the request's key is not an ECDSA key on P-256, but {kind}"


def test_a_request_that_its_key_has_not_signed_is_refused() -> None:
    """Who copies another's request and changes a letter; who takes another's public key."""
    pem = build_request("robot-1", IdentityRole.ROBOT, KEY)
    der = x509.load_pem_x509_csr(pem).public_bytes(Encoding.DER)
    assert der.count(b"robot-1") == 2
    forged = x509.load_der_x509_csr(der.replace(b"robot-1", b"robot-2")).public_bytes(Encoding.PEM)
    assert "not signed with the key that it names" in refusal(forged)


def test_an_old_hash_is_refused() -> None:
    assert "SHA-2" in refusal(signed(builder(uri(ROBOT)), digest=hashes.SHA3_256()))


@pytest.mark.parametrize(
    ("extension", "wish"),
    [
        (x509.BasicConstraints(ca=True, path_length=None), "to be a CA"),
        (x509.BasicConstraints(ca=False, path_length=None), "BasicConstraints"),
        (x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), "ExtendedKeyUsage"),
        (x509.UnrecognizedExtension(x509.ObjectIdentifier("1.2.3.4"), b"\x05\x00"), "1.2.3.4"),
    ],
)
@pytest.mark.parametrize("critical", [True, False])
def test_whoever_asks_for_more_than_a_name_and_role_is_refused(
    extension: x509.ExtensionType, wish: str, critical: bool
) -> None:
    pem = signed(builder(uri(ROBOT)).add_extension(extension, critical=critical))
    assert refusal(pem) == f"the request asks for more than a name and role: {wish}"


def test_an_attribute_beside_is_refused() -> None:
    pem = signed(builder(uri(ROBOT)).add_attribute(AttributeOID.CHALLENGE_PASSWORD, b"x"))
    assert "1.2.840.113549.1.9.7" in refusal(pem)


@pytest.mark.parametrize(
    ("names", "problem"),
    [
        ([], "attributes none"),
        ([x509.DNSName("robot-1")], "0 URIs"),
        ([uri(ROBOT), uri("plr://operator/robot-1")], "2 URIs"),
        ([uri(ROBOT), x509.DNSName(CONTROL_PLANE_DNS)], "alternative names that a robot must not have"),
        ([uri("plr://controlplane/robot-1")], "alternative names that a controlplane must not have"),
        ([uri("plr://admin/robot-1")], "role 'admin' is unknown"),
        ([uri("plr://\x1b[2J/robot-1")], "is unknown"),
        ([uri("http://robot/robot-1")], "plr://role/name"),
        ([uri("plr://robot/\x1b[31mrobot-1")], "not printable"),
        ([uri("plr://robot/robot-1\nrobot-2")], "not printable"),
        ([uri("plr://robot/../robot-1")], "is not a name"),
        ([uri("plr://robot/" + "r" * 64)], "is not a name"),
        ([uri("plr://robot/")], "is not a name"),
    ],
)
def test_names_that_no_certificate_has_are_refused(names: list[x509.GeneralName], problem: str) -> None:
    assert problem in refusal(signed(builder(*names)))


@pytest.mark.parametrize(
    "subject",
    [
        [],
        [x509.NameAttribute(NameOID.COMMON_NAME, "robot-2")],
        [x509.NameAttribute(NameOID.COMMON_NAME, "robot-1\x1b[2J")],
        [x509.NameAttribute(NameOID.COMMON_NAME, "robot-1"), x509.NameAttribute(NameOID.ORGANIZATION_NAME, "x")],
    ],
)
def test_a_subject_that_says_something_else_is_refused(subject: list[x509.NameAttribute[str]]) -> None:
    assert "expected the name alone: CN=robot-1" in refusal(signed(builder(uri(ROBOT), subject=subject)))


def test_a_large_request_is_refused_before_it_is_looked_into() -> None:
    pem = build_request("robot-1", IdentityRole.ROBOT, KEY)
    parse_request(pem.ljust(MAX_CERTIFICATE_REQUEST_BYTES, b"\n"))
    assert "longer than 4096 bytes" in refusal(pem.ljust(MAX_CERTIFICATE_REQUEST_BYTES + 1, b"\n"))


@pytest.mark.parametrize("pem", [b"", b"x", clear_pem(KEY), b"-----BEGIN CERTIFICATE REQUEST-----\nAAAA\n-----END"])
def test_what_is_no_request_is_refused(pem: bytes) -> None:
    assert "malformed" in refusal(pem)


def test_a_request_holds_the_names_of_the_certificate() -> None:
    request = x509.load_pem_x509_csr(build_request("cp", IdentityRole.CONTROL_PLANE, KEY))
    (extension,) = request.extensions
    assert extension.value == alternative_names("cp", IdentityRole.CONTROL_PLANE)


@pytest.mark.skipif(shutil.which("openssl") is None, reason="needs OpenSSL's command line")
@pytest.mark.parametrize("written", ["named_curve", "explicit"])
def test_openssl_can_ask_too_and_a_key_is_the_same_however_it_is_written(tmp_path: Path, written: str) -> None:
    key, other, path = tmp_path / "key.pem", tmp_path / "other.pem", tmp_path / "request.pem"
    key.write_bytes(clear_pem(KEY))
    convert = ["openssl", "ec", "-in", str(key), "-param_enc", written, "-out", str(other)]
    subprocess.run(convert, check=True, capture_output=True)
    name = ["-subj", "/CN=robot-1", "-addext", f"subjectAltName=URI:{ROBOT}"]
    subprocess.run(["openssl", "req", "-new", "-key", str(other), *name, "-out", str(path)], check=True)
    request = parse_request(path.read_bytes())
    assert (request.name, request.role) == ("robot-1", IdentityRole.ROBOT)
    assert fingerprint(request.key) == fingerprint(KEY.public_key())
