from __future__ import annotations

import hashlib
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import NodeName, Role, SessionId
from plr.protos.model.members import MAX_CREDENTIAL_BYTES
from plr.protos.trust.credential import Aead, SessionCredential, decode_credential, session_number, verify
from plr.protos.trust.identity import CertificateError, Identity, IdentityRole
from tests.unit.protos import message_strategies as some

credentials = st.builds(
    SessionCredential,
    some.node_names,
    st.sampled_from(Role),
    some.sessions,
    some.uint64,
    st.binary(min_size=32, max_size=32),
    st.sampled_from(Aead),
    st.binary(max_size=900),
    st.binary(max_size=72),
)
PLAIN = SessionCredential(NodeName("robot-1"), Role.ROBOT, SessionId(0x0102), 3, bytes(range(32)), Aead.AES_256_GCM)


def believes_all(name: str = "robot-1", role: IdentityRole = IdentityRole.ROBOT) -> Identity:
    return Identity(NodeName(name), role, 1, 0.0, 1.0)


def test_the_bytes_of_a_credential() -> None:
    credential = replace(PLAIN, certificate=b"CERT", signature=b"SIG")
    golden = "01 01 01 07 0000000000000102 0000000000000003" + bytes(range(32)).hex() + "0004"
    assert credential.encode() == bytes.fromhex(golden) + b"robot-1" + b"CERT" + b"\x03SIG"


@pytest.mark.audit("sec-4")
def test_a_sessions_number_belongs_to_name_role_and_key() -> None:
    """Also who knows another's public key, which is no secret, gets another number."""
    name, role, key = PLAIN.name, PLAIN.role, PLAIN.public_key
    number = session_number(name, role, key)
    assert number == int.from_bytes(
        hashlib.sha256(b"plr session number\0" + b"\x01\x07robot-1" + key).digest()[:8], "big"
    )
    others = [
        session_number(NodeName("robot-2"), role, key),
        session_number(name, Role.CLOUD, key),
        session_number(name, role, bytes(32)),
    ]
    assert len({number, *others}) == 4


@given(credentials)
def test_credentials_come_back(credential: SessionCredential) -> None:
    assert decode_credential(credential.encode()) == credential


@given(credentials, st.lists(st.tuples(st.integers(0, 1100), st.integers(0, 255)), max_size=3), st.integers(-20, 3))
@settings(max_examples=300)
def test_a_mangled_credential_is_a_value_or_the_one_error(
    credential: SessionCredential, changes: list[tuple[int, int]], longer: int
) -> None:
    data = bytearray(credential.encode())
    data = data[:longer] if longer < 0 else data + bytes(longer)
    for position, value in changes:
        data[position % len(data)] = value
    try:
        decoded = decode_credential(bytes(data))
    except DecodeError:
        return
    assert decoded.encode() == data, "one credential, one encoding"
    with pytest.raises(CertificateError):
        verify(replace(decoded, certificate=b"no certificate"), lambda _: believes_all(decoded.name))


@given(st.binary(max_size=200))
def test_any_bytes_are_a_credential_or_the_one_error(data: bytes) -> None:
    try:
        decode_credential(data)
    except DecodeError:
        return


def test_nothing_longer_than_the_cap_is_read() -> None:
    data = replace(PLAIN, certificate=bytes(MAX_CREDENTIAL_BYTES)).encode()
    with pytest.raises(DecodeError, match="more than"):
        decode_credential(data)
