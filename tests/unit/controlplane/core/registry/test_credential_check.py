"""A registration says what its certificate says, and brings its own credential."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.ca import Authority, Issued
from plr.controlplane.core.registry.credential_check import check_claims, check_unproven_claims
from plr.controlplane.core.registry.registry import Refusal
from plr.protos.model.ids import NodeName, Role
from plr.protos.trust.credential import Aead, SessionCredential, session_number
from plr.protos.trust.identity import Identity, IdentityRole, Trust
from tests.support.samples import registration as sample

if TYPE_CHECKING:
    from plr.protos.model.members import Registration


@pytest.fixture(scope="module")
def authority() -> Authority:
    return Authority.create()


@pytest.fixture(scope="module")
def issued(authority: Authority) -> Issued:
    return authority.issue("robot-1", IdentityRole.ROBOT)


@pytest.fixture(scope="module")
def identity(authority: Authority, issued: Issued) -> Identity:
    return Trust(authority.ca_pem).identify(issued.certificate_der)


KEY = bytes(32)


def registration(name: str, role: Role = Role.ROBOT) -> Registration:
    return replace(sample(name, role), session=session_number(NodeName(name), role, KEY))


def credential(said: Registration, certificate: bytes = b"") -> SessionCredential:
    return SessionCredential(said.name, said.role, said.session, said.incarnation, KEY, Aead.AES_256_GCM, certificate)


def test_what_agrees_is_accepted(issued: Issued, identity: Identity) -> None:
    said = registration("robot-1")
    own = credential(said, issued.certificate_der).sign(issued.key).encode()
    assert check_claims(replace(said, credential=own), identity, issued.certificate_der) is None


def test_another_name_or_role_is_refused(issued: Issued, identity: Identity) -> None:
    der = issued.certificate_der
    assert check_claims(registration("robot-2"), identity, der) is Refusal.NAME_MISMATCH
    assert check_claims(registration("robot-1", Role.CLOUD), identity, der) is Refusal.WRONG_ROLE


def test_a_credential_that_is_not_its_own_is_refused(authority: Authority, issued: Issued, identity: Identity) -> None:
    said = registration("robot-1")
    good = credential(said, issued.certificate_der)
    other = authority.renew("robot-1")
    bad = [
        b"",
        good.encode(),
        good.sign(other.key).encode(),
        credential(said, other.certificate_der).sign(other.key).encode(),
        replace(good, session=type(said.session)(said.session + 1)).sign(issued.key).encode(),
        replace(good, incarnation=said.incarnation + 1).sign(issued.key).encode(),
        replace(good, name=NodeName("robot-2")).sign(issued.key).encode(),
        replace(good, role=Role.CLOUD).sign(issued.key).encode(),
    ]
    for encoded in bad:
        claimed = replace(said, credential=encoded)
        assert check_claims(claimed, identity, issued.certificate_der) is Refusal.BAD_CREDENTIAL


def test_without_certificates_a_credential_has_to_agree_all_the_same(issued: Issued) -> None:
    said = registration("robot-1")
    assert check_unproven_claims(said) is None
    assert check_unproven_claims(replace(said, credential=credential(said).encode())) is None
    for encoded in (b"junk", credential(registration("robot-2")).encode(), credential(said, b"certificate").encode()):
        assert check_unproven_claims(replace(said, credential=encoded)) is Refusal.BAD_CREDENTIAL
