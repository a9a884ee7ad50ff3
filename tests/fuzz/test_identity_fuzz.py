"""Whatever is shown as a certificate, a CA or a revocation list: CertificateError and nothing else refuses it."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from plr.controlplane.ca import Authority
from plr.protos.model.ids import NodeName, Role, SessionId
from plr.protos.trust.credential import Aead, SessionCredential, verify
from plr.protos.trust.identity import CertificateError, IdentityRole, Trust
from tests.support.forged import NOW, Recipe, uri

CA = Authority.create(clock=lambda: NOW)
GOOD = CA.issue("robot-1", IdentityRole.ROBOT).certificate_der
CA.revoke("robot-1")
CRL = CA.crl_pem()
TRUST = Trust(CA.ca_pem)
IDENTITY = TRUST.identify(GOOD)
P_256 = bytes.fromhex("06082a8648ce3d030107")
"""The curve's name in DER."""

Edits = list[tuple[int, int]]
edits: st.SearchStrategy[Edits] = st.lists(st.tuples(st.integers(0, 5000), st.integers(0, 255)), min_size=1, max_size=4)


def edited(data: bytes, changes: Edits) -> bytes:
    changed = bytearray(data)
    for place, value in changes:
        changed[place % len(changed)] = value
    return bytes(changed)


@given(st.binary(max_size=2000))
@example(GOOD[:-1])
def test_any_bytes(data: bytes) -> None:
    with contextlib.suppress(CertificateError):
        TRUST.check(data, NOW)
        raise AssertionError("believed")


@given(edits)
def test_a_certificate_changed_anywhere_is_not_believed(changes: Edits) -> None:
    der = edited(GOOD, changes)
    if der == GOOD:
        return
    with contextlib.suppress(CertificateError):
        TRUST.check(der, NOW)
        raise AssertionError("believed")


@given(edits)
@example([(GOOD.index(P_256) + len(P_256) - 1, 6)])
def test_a_credential_whose_certificate_is_changed_anywhere_is_not_believed(changes: Edits) -> None:
    """Also by one who asks nothing but whether the certificate's key signed it."""
    own = SessionCredential(
        NodeName("robot-1"), Role.ROBOT, SessionId(1), 1, bytes(32), Aead.AES_256_GCM, edited(GOOD, changes), bytes(70)
    )
    with pytest.raises(CertificateError):
        verify(own, lambda _: IDENTITY)


@given(st.integers(0, 5000), st.integers(0, 5000))
def test_a_certificate_with_a_piece_cut_out_is_not_believed(start: int, length: int) -> None:
    start %= len(GOOD)
    with contextlib.suppress(CertificateError):
        TRUST.check(GOOD[:start] + GOOD[start + 1 + length % 50 :], NOW)
        raise AssertionError("believed")


@given(st.text(max_size=80).filter(str.isascii))
def test_any_uri_that_the_ca_has_signed(text: str) -> None:
    der = Recipe(names=[uri(text)]).der(CA)
    with contextlib.suppress(CertificateError):
        identity = TRUST.check(der, NOW)
        assert f"plr://{identity.role.value}/{identity.name}" == text


@given(edits)
def test_a_ca_changed_anywhere(changes: Edits) -> None:
    with contextlib.suppress(CertificateError):
        Trust(edited(CA.ca_pem, changes)).check(GOOD, NOW)


@given(edits)
def test_a_revocation_list_changed_anywhere_never_lets_the_revoked_in(changes: Edits) -> None:
    with contextlib.suppress(CertificateError):
        Trust(CA.ca_pem, edited(CRL, changes)).check(GOOD, NOW)
        raise AssertionError("the revoked certificate is believed")
