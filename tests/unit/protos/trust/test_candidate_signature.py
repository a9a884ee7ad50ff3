"""What a sidecar signs of its addresses: other candidates are other bytes, and only its own key signs them."""

from __future__ import annotations

import pytest
from cryptography.hazmat.primitives.asymmetric import ec
from hypothesis import given
from hypothesis import strategies as st

from plr.controlplane.ca import Authority
from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import InterfaceId, InterfaceName, SessionId
from plr.protos.model.members import MAX_SIGNATURE_BYTES, Candidate, CandidateKind
from plr.protos.trust.candidate_signature import sign_candidates, signed_bytes, verify_candidates
from plr.protos.trust.identity import CertificateError, IdentityRole
from tests.unit.protos import message_strategies as some

pytestmark = pytest.mark.audit("sec-5")

SESSION = SessionId(0x0102)
CANDIDATES = (
    Candidate(InterfaceId(0), InterfaceName("eth0"), CandidateKind.HOST, ("192.0.2.1", 24700)),
    Candidate(InterfaceId(3), InterfaceName("wwan0"), CandidateKind.SERVER_REFLEXIVE, ("2001:db8::1", 1)),
)
GOOD = Authority.create().issue("robot-1", IdentityRole.ROBOT)
announcements = st.tuples(some.sessions, some.uint64, some.candidate_tuples())


def test_the_bytes_that_are_signed() -> None:
    head = b"plr candidates\0" + bytes.fromhex("0000000000000102 0000000000000007 0002")
    first = bytes.fromhex("00 01 607c") + b"\x04eth0" + b"\x09192.0.2.1"
    second = bytes.fromhex("03 02 0001") + b"\x05wwan0" + b"\x0b2001:db8::1"
    assert signed_bytes(SESSION, 7, CANDIDATES) == head + first + second
    assert signed_bytes(SESSION, 7, ()) == head[:-1] + b"\0"


@given(announcements, announcements)
def test_other_announcements_are_other_bytes(
    one: tuple[SessionId, int, tuple[Candidate, ...]], other: tuple[SessionId, int, tuple[Candidate, ...]]
) -> None:
    assert (signed_bytes(*one) == signed_bytes(*other)) == (one == other)


def test_a_signature_is_good_for_what_it_signs_and_for_nothing_else() -> None:
    signature = sign_candidates(GOOD.key, SESSION, 7, CANDIDATES)
    assert len(signature) <= MAX_SIGNATURE_BYTES
    verify_candidates(GOOD.certificate_der, SESSION, 7, CANDIDATES, signature)
    for session, serial, candidates, claimed in (
        (SessionId(9), 7, CANDIDATES, signature),
        (SESSION, 8, CANDIDATES, signature),
        (SESSION, 7, CANDIDATES[:1], signature),
        (SESSION, 7, CANDIDATES[::-1], signature),
        (SESSION, 7, (*CANDIDATES, CANDIDATES[0]), signature),
        (SESSION, 7, CANDIDATES, b""),
        (SESSION, 7, CANDIDATES, signature[:-1]),
        (SESSION, 7, CANDIDATES, bytes(MAX_SIGNATURE_BYTES)),
        (SESSION, 7, CANDIDATES, sign_candidates(ec.generate_private_key(ec.SECP256R1()), SESSION, 7, CANDIDATES)),
    ):
        with pytest.raises(CertificateError):
            verify_candidates(GOOD.certificate_der, session, serial, candidates, claimed)


@given(st.binary(max_size=900), st.binary(max_size=MAX_SIGNATURE_BYTES), announcements)
def test_whatever_is_told_is_refused_as_what_it_is(
    certificate: bytes, signature: bytes, told: tuple[SessionId, int, tuple[Candidate, ...]]
) -> None:
    with pytest.raises(DecodeError):
        verify_candidates(certificate, *told, signature)


@given(st.binary(max_size=MAX_SIGNATURE_BYTES), announcements)
def test_so_is_any_signature_under_a_good_certificate(
    signature: bytes, told: tuple[SessionId, int, tuple[Candidate, ...]]
) -> None:
    with pytest.raises(DecodeError):
        verify_candidates(GOOD.certificate_der, *told, signature)
