"""Whatever is shown as a request for a certificate: DecodeError and nothing else refuses it, in printable words."""

from __future__ import annotations

import base64

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding
from hypothesis import given
from hypothesis import strategies as st

from plr.controlplane.ca.certificates import generate_key
from plr.controlplane.ca.request import build_request, parse_request
from plr.protos.base.errors import DecodeError
from plr.protos.trust.identity import IdentityRole

pytestmark = pytest.mark.audit("sec-11")

PEM = build_request("robot-1", IdentityRole.ROBOT, generate_key())
DER = x509.load_pem_x509_csr(PEM).public_bytes(Encoding.DER)


def refused(pem: bytes) -> bool:
    text = ""
    try:
        parse_request(pem)
    except DecodeError as error:
        text = str(error)
    assert text.isprintable()
    return text != ""


def in_pem(der: bytes) -> bytes:
    return b"-----BEGIN CERTIFICATE REQUEST-----\n%s\n-----END CERTIFICATE REQUEST-----\n" % base64.b64encode(der)


@given(st.binary(max_size=5000))
def test_any_bytes(data: bytes) -> None:
    assert refused(data)
    assert refused(in_pem(data))


@given(st.lists(st.tuples(st.integers(0, len(DER) - 1), st.integers(0, 255)), min_size=1, max_size=4))
def test_a_request_changed_anywhere_is_refused(changes: list[tuple[int, int]]) -> None:
    der = bytearray(DER)
    for place, value in changes:
        der[place] = value
    assert refused(in_pem(bytes(der))) or bytes(der) == DER
