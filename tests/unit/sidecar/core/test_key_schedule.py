from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protos.credential import Aead, SessionCredential
from protos.model import InterfaceId, NodeName, Role, SessionId
from sidecar.core.key_schedule import PairKeys, next_phase, pair_keys, phase_key
from tests.sessions import session_of, with_credential
from tests.unit.sidecar.core.builders import peer

ROBOT = SessionCredential(NodeName("robot-1"), Role.ROBOT, SessionId(1), 2, bytes(range(32)), Aead.AES_256_GCM)
CLOUD = SessionCredential(NodeName("cloud-a"), Role.CLOUD, SessionId(3), 4, bytes(range(32, 64)), Aead.AES_256_GCM)
SHARED = bytes(range(64, 96))
LOW, HIGH = InterfaceId(1), InterfaceId(2)


def test_the_layout_is_what_it_was() -> None:
    """Another layout is another PROTOCOL_VERSION."""
    pair = pair_keys(SHARED, ROBOT, CLOUD)
    path = pair.sending(LOW, HIGH)
    assert [value.hex()[:16] for value in (pair.secret, path, phase_key(path), next_phase(path))] == [
        "47a9bd22c844182b", "c2a53f130afca94e", "66e77e7b33d1474f", "537fc33f81882c44",
    ]  # fmt: skip


@given(st.integers(0, 255).map(InterfaceId), st.integers(0, 255).map(InterfaceId))
def test_both_ends_agree_and_the_directions_differ(ours: InterfaceId, theirs: InterfaceId) -> None:
    robot, cloud = pair_keys(SHARED, ROBOT, CLOUD), pair_keys(SHARED, CLOUD, ROBOT)
    assert robot.sending(ours, theirs) == cloud.receiving(theirs, ours)
    assert robot.receiving(ours, theirs) == cloud.sending(theirs, ours)
    assert robot.sending(ours, theirs) != robot.receiving(ours, theirs)
    assert robot.sending(ours, theirs) != robot.receiving(theirs, ours)


def test_two_sessions_come_to_the_same_keys_from_their_own_private_keys() -> None:
    robot, cloud = session_of("robot-1", Role.ROBOT, 7), session_of("cloud-a", Role.CLOUD, 8)
    for_robot = robot.admit(peer("cloud-a", session=8))
    me = with_credential(replace(peer("robot-1", session=7), role=Role.ROBOT))
    assert for_robot.secret == cloud.admit(me).secret


CHANGES = {
    "name": {"name": NodeName("robot-2")},
    "role": {"role": Role.CLOUD},
    "session": {"session": SessionId(9)},
    "incarnation": {"incarnation": 9},
    "public key": {"public_key": bytes(32)},
    "AEAD": {"aead": Aead.CHACHA20_POLY1305},
}


@pytest.mark.parametrize("what", CHANGES)
def test_whatever_they_differ_in_gives_other_keys(what: str) -> None:
    changed: SessionCredential = replace(ROBOT, **CHANGES[what])  # type: ignore[arg-type]  # the table's values fit
    assert pair_keys(SHARED, changed, CLOUD).secret != pair_keys(SHARED, ROBOT, CLOUD).secret


def test_a_credential_signed_anew_gives_the_same_keys() -> None:
    again = replace(ROBOT, certificate=b"renewed", signature=b"again")
    assert pair_keys(SHARED, again, CLOUD) == pair_keys(SHARED, ROBOT, CLOUD)


def test_the_secret_is_not_shown() -> None:
    pair = PairKeys(b"s" * 32, Aead.AES_256_GCM, first=True)
    assert "ss" not in repr(pair)


@given(st.binary(min_size=32, max_size=32))
def test_every_phase_has_another_key(secret: bytes) -> None:
    keys, now = set(), secret
    for _ in range(10):
        keys |= {phase_key(now), now}
        now = next_phase(now)
    assert len(keys) == 20
