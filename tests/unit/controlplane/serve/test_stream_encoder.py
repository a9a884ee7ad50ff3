"""What is written to the streams says what it is made of, however it is cut and whatever is kept."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plr.controlplane.core.publish.told_peers import ToldPeers
from plr.controlplane.serve import stream_encoder
from plr.controlplane.serve.stream_encoder import StreamEncoder
from plr.protos.convert import parse_control_message
from plr.protos.model.ids import NodeName, Role, ServiceName, SessionId, Version
from plr.protos.model.members import Peer, PeerSet, RemovalReason, RemovedPeer, ServiceOffer
from tests.unit.protos.message_strategies import control_messages, peers

ENCODER = StreamEncoder()


@given(message=control_messages.filter(lambda message: not isinstance(message, PeerSet) or not message.more))
def test_messages_survive_the_stream(message: object) -> None:
    (data,) = ENCODER.encode(message, incremental=False)  # type: ignore[arg-type]
    assert parse_control_message(data) == message


@given(
    present=st.lists(peers, unique_by=lambda peer: peer.name, max_size=6).map(tuple),
    part_bytes=st.sampled_from((1, 200, 2000, 1 << 20)),
)
def test_parts_make_the_set_that_the_sidecar_is_told(present: tuple[Peer, ...], part_bytes: int) -> None:
    told = ToldPeers(present, NodeName("me"), Role.ROBOT)
    removed = (RemovedPeer(NodeName("not-among-them-at-all"), RemovalReason.LEFT),)
    message = PeerSet(Version(9), 4, told, removed, 7, Version(3))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stream_encoder, "PART_BYTES", part_bytes)
        for _ in range(2):
            parts = [parse_control_message(data) for data in ENCODER.encode(message, incremental=True)]
            assert all(isinstance(part, PeerSet) for part in parts)
            sets = [part for part in parts if isinstance(part, PeerSet)]
            assert [part.more for part in sets] == [True] * (len(sets) - 1) + [False]
            assert {(part.version, part.nonce, part.base, part.policy) for part in sets} == {(9, 4, 3, 7)}
            assert tuple(peer for part in sets for peer in part.peers) == tuple(told)
            assert tuple(gone for part in sets for gone in part.removed) == removed
            if part_bytes == 1:
                assert len(sets) == max(len(present), 1)


def test_what_is_kept_is_bounded_and_never_another_peers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream_encoder, "MAX_KEPT_ENCODINGS", 10)
    encoder = StreamEncoder()
    for number in range(100):
        told = ToldPeers(
            (Peer(NodeName(f"n{number}"), Role.CLOUD, SessionId(number + 1), bytes(16), 1),), NodeName("me"), Role.ROBOT
        )
        (data,) = encoder.encode(PeerSet(Version(1), 1, told), incremental=True)
        parsed = parse_control_message(data)
        assert isinstance(parsed, PeerSet)
        assert tuple(parsed.peers) == tuple(told)
    assert len(encoder._encoded) <= 10


@pytest.mark.audit("ops-16")
def test_what_is_kept_is_bounded_by_its_bytes_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream_encoder, "MAX_KEPT_BYTES", 10_000)
    encoder = StreamEncoder()
    offers = tuple(ServiceOffer(ServiceName(f"/s{number}"), "std_srvs/srv/Trigger") for number in range(100))
    most = 0
    for number in range(20):
        peer = Peer(NodeName("cloud"), Role.CLOUD, SessionId(number + 1), bytes(16), 1, offers=offers)
        list(encoder.encode(PeerSet(Version(1), 1, ToldPeers((peer,), NodeName("me"), Role.ROBOT)), incremental=True))
        most = max(most, sum(len(data) for _, data in encoder._encoded.values()))
        assert encoder._kept_bytes <= 10_000
    assert 5_000 < most <= 10_000
