"""What a sidecar introduces itself with to one peer: nothing follows from it for another."""

from __future__ import annotations

import pytest
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDFExpand

from plr.protos.model.ids import NodeName, Role
from plr.protos.model.members import TOKEN_BYTES
from plr.protos.trust.pair_token import pair_token

TOKEN, ROBOT = bytes(range(16)), NodeName("robot-1")


def test_it_is_hkdf_expand() -> None:
    info = b"plr 2 pair token\x01robot-1"
    assert pair_token(TOKEN, ROBOT, Role.ROBOT) == HKDFExpand(SHA256(), TOKEN_BYTES, info).derive(TOKEN)


def test_its_layout_stays() -> None:
    assert pair_token(TOKEN, ROBOT, Role.ROBOT).hex() == "b70f666a863c4d0c463421ad737d1419"


@pytest.mark.audit("sec-5")
def test_every_owner_and_every_receiver_has_another() -> None:
    tokens = {
        pair_token(own, NodeName(name), role)
        for own in (TOKEN, bytes(16), pair_token(TOKEN, ROBOT, Role.ROBOT))
        for name in ("robot-1", "robot-2", "robot-")
        for role in Role
    }
    assert len(tokens) == 3 * 3 * 2
    assert TOKEN not in tokens
