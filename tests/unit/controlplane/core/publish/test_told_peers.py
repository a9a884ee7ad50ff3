"""What one sidecar learns about the others: each peer with the token for this sidecar."""

from __future__ import annotations

from dataclasses import fields, replace

from plr.controlplane.core.publish.told_peers import ToldPeers
from plr.protos.model.ids import NodeName, Role, SessionId
from plr.protos.model.members import ALL_CALLS, Peer
from plr.protos.trust.pair_token import pair_token
from tests.support.samples import interfaces, offer

ROBOT = NodeName("robot")
PEER = Peer(
    NodeName("a"),
    Role.CLOUD,
    SessionId(1),
    bytes(range(16)),
    7,
    interfaces("eth0"),
    (offer(),),
    draining=True,
    credential=b"signed",
    may_call=ALL_CALLS,
    candidates_serial=3,
    candidates_signature=b"signed",
)
OTHER = replace(PEER, name=NodeName("b"), token=bytes(16))


def test_a_peer_with_another_token_is_otherwise_the_same() -> None:
    bare = Peer(NodeName(""), Role.ROBOT, SessionId(0), b"", 0)
    assert all(getattr(PEER, field.name) != getattr(bare, field.name) for field in fields(Peer)), "each is looked at"
    assert PEER.with_token(b"another") == replace(PEER, token=b"another")


def test_each_peer_is_told_with_its_token_for_the_one_who_is_told() -> None:
    expected = [replace(peer, token=pair_token(peer.token, ROBOT, Role.ROBOT)) for peer in (PEER, OTHER)]
    told = ToldPeers((PEER, OTHER), ROBOT, Role.ROBOT)
    assert list(told) == expected
    assert (len(told), told[1], told[:1]) == (2, expected[1], expected[:1])
    assert told == ToldPeers((PEER, OTHER), ROBOT, Role.ROBOT)
    assert hash(told) == hash(ToldPeers((PEER, OTHER), ROBOT, Role.ROBOT))
    assert told != ToldPeers((PEER, OTHER), NodeName("robot-2"), Role.ROBOT)
    assert told != 2
