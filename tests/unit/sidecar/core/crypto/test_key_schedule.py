from __future__ import annotations

from dataclasses import replace

import pytest
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey
from hypothesis import given
from hypothesis import strategies as st

from lab.simulated.sessions import session_of, with_credential
from plr.protos.model.ids import InterfaceId, NodeName, Role, SessionId
from plr.protos.trust.credential import Aead, SessionCredential
from plr.sidecar.core.crypto.key_schedule import PairKeys, next_root, pair_keys, proof
from tests.support.builders import peer

OURS, THEIRS = (X25519PrivateKey.from_private_bytes(bytes([number]) * 32) for number in (1, 2))
ROBOT = SessionCredential(NodeName("robot-1"), Role.ROBOT, SessionId(1), 2, bytes(range(32)), Aead.AES_256_GCM)
CLOUD = SessionCredential(NodeName("cloud-a"), Role.CLOUD, SessionId(3), 4, bytes(range(32, 64)), Aead.AES_256_GCM)
LOW, HIGH = InterfaceId(1), InterfaceId(2)


def keys_of(robot: SessionCredential = ROBOT, cloud: SessionCredential = CLOUD) -> PairKeys:
    return pair_keys(OURS, THEIRS.public_key(), robot, cloud)


def keys_of_cloud() -> PairKeys:
    return pair_keys(THEIRS, OURS.public_key(), CLOUD, ROBOT)


def test_the_layout_is_what_it_was() -> None:
    """Another layout is another PROTOCOL_VERSION."""
    pair = keys_of()
    root = pair.root(LOW, HIGH)
    further = next_root(root, bytes(range(96)), 1, bytes(range(32)), bytes(range(32, 64)))
    values = (pair.secret, root, pair.sealing_key(root), pair.opening_key(root), further, proof(further))
    assert [value.hex()[:16] for value in values] == [
        "1968e0e4d2913067", "455470c6d84f6b90", "555438d292da8c75", "7270987f7ec8323a", "fb809cb39a95f684",
        "6f2e2ef050203a5d",
    ]  # fmt: skip


@given(st.integers(0, 255).map(InterfaceId), st.integers(0, 255).map(InterfaceId))
def test_both_ends_agree_and_the_directions_differ(ours: InterfaceId, theirs: InterfaceId) -> None:
    robot, cloud = keys_of(), keys_of_cloud()
    root = robot.root(ours, theirs)
    assert root == cloud.root(theirs, ours)
    assert robot.sealing_key(root) == cloud.opening_key(root)
    assert robot.opening_key(root) == cloud.sealing_key(root)
    assert robot.sealing_key(root) != robot.opening_key(root)
    assert ours == theirs or robot.root(theirs, ours) != root


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
    assert keys_of(changed).secret != keys_of().secret


def test_a_credential_signed_again_gives_the_same_keys() -> None:
    again = replace(ROBOT, certificate=b"renewed", signature=b"again")
    assert keys_of(again) == keys_of()


def test_the_secret_is_not_shown() -> None:
    pair = PairKeys(b"s" * 32, Aead.AES_256_GCM, first=True, own=OURS, theirs=THEIRS.public_key())
    assert "ss" not in repr(pair)


@given(st.binary(min_size=32, max_size=32), st.binary(min_size=96, max_size=96))
def test_every_phase_has_other_keys(root: bytes, shared: bytes) -> None:
    pair, found = keys_of(), set()
    for phase in range(1, 11):
        root = next_root(root, shared, phase, bytes(32), bytes(32))
        found |= {root, pair.sealing_key(root), pair.opening_key(root), proof(root)}
    assert len(found) == 40
