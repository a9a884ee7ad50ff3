"""Versions, nonces, acks and nacks of one resource."""

from __future__ import annotations

from typing import Any

import pytest

from plr.controlplane.core.publish.snapshots import MAX_LIFTED, PeerView, Snapshots, Track, VersionSource
from plr.controlplane.core.publish.told_peers import ToldPeers
from plr.protos.model.ids import MAX_VERSION, NodeName, Role, SessionId, Version
from plr.protos.model.members import Peer
from plr.protos.model.status import SyncState
from plr.protos.model.stream import Ack, Nack, ResourceKind

EPOCH = 1000


def state(track: Track[Any]) -> SyncState:
    return track.status.state


def ack(track: Track[Any], *, nonce: int | None = None, version: int | None = None) -> bool:
    return track.ack(
        Ack(
            ResourceKind.PEERS,
            Version(version if version is not None else track.version_sent),
            nonce if nonce is not None else track.nonce,
        )
    )


def nack(track: Track[Any], *, nonce: int | None = None, in_force: int = 0) -> bool:
    answer = Nack(ResourceKind.PEERS, Version(in_force), nonce if nonce is not None else track.nonce, "no such peer")
    return track.nack(answer)


@pytest.fixture
def versions() -> VersionSource:
    return VersionSource(EPOCH)


def test_versions_only_grow_and_start_above_the_epoch(versions: VersionSource) -> None:
    first = versions.above(Version(0))
    assert first > EPOCH
    assert versions.above(Version(0)) > first


def test_a_sidecar_that_holds_more_than_the_epoch_gets_still_more(versions: VersionSource) -> None:
    high = Version(EPOCH * 1000)
    assert versions.above(high) == high + 1
    # Its claim does not carry everybody else along.
    assert versions.above(Version(0)) < high


def test_from_sent_to_synced(versions: VersionSource) -> None:
    track: Track[str] = Track()
    assert state(track) is SyncState.NOT_SENT
    version = track.send("a", versions)
    assert state(track) is SyncState.STALE
    assert ack(track)
    assert state(track) is SyncState.SYNCED
    assert track.status.version_acked == version


def test_a_nack_is_never_shown_as_synced(versions: VersionSource) -> None:
    track: Track[str] = Track()
    track.send("a", versions)
    assert nack(track)
    assert state(track) is SyncState.REJECTED
    assert track.status.error == "no such peer"
    assert not ack(track)
    assert state(track) is SyncState.REJECTED
    track.send("b", versions)
    assert state(track) is SyncState.STALE
    assert track.error == ""
    assert ack(track)


def test_a_refusal_for_the_same_reason_is_no_news_until_something_is_taken(versions: VersionSource) -> None:
    track: Track[str] = Track()
    told = []
    for taken in (False, False, True, False):
        track.send("a", versions)
        if taken:
            ack(track)
        else:
            nack(track)
            told.append(not track.refused_as_before)
    assert told == [True, False, True]
    track.begin_stream(Version(0))
    track.send("a", versions)
    nack(track)
    assert not track.refused_as_before


def test_only_what_is_refused_is_sent_again(versions: VersionSource) -> None:
    snapshots = Snapshots()
    send_peers(snapshots, versions, "a")
    snapshots.send_mapping((), versions, 0.0)
    snapshots.send_refused_again()
    assert not snapshots.peers.send_again
    nack(snapshots.track(ResourceKind.MAPPING))
    snapshots.send_refused_again()
    assert (snapshots.peers.send_again, snapshots.mapping.send_again) == (False, True)
    snapshots.send_mapping((), versions, 0.0)
    assert not snapshots.mapping.send_again


@pytest.mark.audit("dp-12")
def test_what_is_refused_stays_so_while_it_is_sent_again(versions: VersionSource) -> None:
    snapshots = Snapshots()
    snapshots.send_mapping((), versions, 0.0)
    assert nack(snapshots.mapping)
    for _ in range(2):
        snapshots.send_refused_again()
        snapshots.send_mapping((), versions, 0.0)
        assert (state(snapshots.mapping), snapshots.mapping.error) == (SyncState.REJECTED, "no such peer")
        snapshots.send_refused_again()
        assert not snapshots.mapping.send_again, "not answered yet"
        assert nack(snapshots.mapping)
    snapshots.send_refused_again()
    snapshots.send_mapping((), versions, 0.0)
    assert ack(snapshots.mapping)
    assert (state(snapshots.mapping), snapshots.mapping.error) == (SyncState.SYNCED, "")


def test_who_took_what_was_sent_again_and_lost_its_stream_needs_nothing(versions: VersionSource) -> None:
    snapshots = Snapshots()
    snapshots.send_mapping((), versions, 0.0)
    assert nack(snapshots.mapping)
    snapshots.send_refused_again()
    snapshots.mapping.begin_stream(snapshots.send_mapping((), versions, 0.0).version)
    assert (state(snapshots.mapping), snapshots.mapping.error) == (SyncState.SYNCED, "")


def test_a_nack_after_the_ack_wins(versions: VersionSource) -> None:
    track: Track[str] = Track()
    track.send("a", versions)
    ack(track)
    assert nack(track, in_force=3)
    assert state(track) is SyncState.REJECTED
    assert track.version_acked == 3


def test_stale_nonces_are_ignored(versions: VersionSource) -> None:
    track: Track[str] = Track()
    old_version = track.send("a", versions)
    old_nonce = track.nonce
    track.send("b", versions)
    assert not ack(track, nonce=old_nonce, version=old_version)
    assert not nack(track, nonce=old_nonce)
    assert not ack(track, version=old_version)
    assert state(track) is SyncState.STALE
    assert ack(track)


def test_who_reconnects_with_the_version_sent_last_needs_nothing(versions: VersionSource) -> None:
    track: Track[str] = Track()
    version = track.send("a", versions)
    track.begin_stream(version)
    assert state(track) is SyncState.SYNCED
    assert track.sent == "a"


def test_who_reconnects_with_another_version_is_sent_everything_again(versions: VersionSource) -> None:
    track: Track[str] = Track()
    track.send("a", versions)
    ack(track)
    second = track.send("b", versions)
    track.begin_stream(Version(0))
    assert state(track) is SyncState.NOT_SENT
    assert track.sent is None
    assert track.send("b", versions) > second


def test_a_refused_version_is_sent_again_on_the_next_stream(versions: VersionSource) -> None:
    track: Track[str] = Track()
    version = track.send("a", versions)
    nack(track)
    track.begin_stream(version)
    assert state(track) is SyncState.NOT_SENT
    assert track.sent is None


def peer(name: str) -> Peer:
    return Peer(NodeName(name), Role.CLOUD, SessionId(1), bytes(16), 1)


def send_peers(snapshots: Snapshots, versions: VersionSource, *names: str) -> None:
    peers = tuple(peer(name) for name in names)
    snapshots.send_peers(PeerView(peers), ToldPeers(peers, NodeName("robot"), Role.ROBOT), (), Version(0), versions)


def test_names_a_sidecar_may_know_grow_until_it_acknowledges(versions: VersionSource) -> None:
    snapshots = Snapshots()
    send_peers(snapshots, versions, "a", "b")
    send_peers(snapshots, versions, "b", "c")
    assert snapshots.known_names == {"a", "b", "c"}
    stale = Ack(ResourceKind.PEERS, snapshots.peers.version_sent, snapshots.peers.nonce - 1)
    assert not snapshots.peers_acked(stale)
    assert snapshots.known_names == {"a", "b", "c"}
    assert snapshots.peers_acked(Ack(ResourceKind.PEERS, snapshots.peers.version_sent, snapshots.peers.nonce))
    assert snapshots.known_names == {"b", "c"}


@pytest.mark.audit("ops-17")
def test_who_holds_what_no_control_plane_of_ours_gave_out_starts_over(versions: VersionSource) -> None:
    track: Track[tuple[int, ...]] = Track()
    for held in (MAX_VERSION, MAX_LIFTED):
        track.begin_stream(Version(held))
        first, then = track.send((1,), versions), track.send((2,), versions)
        assert first < then < MAX_LIFTED
    track.begin_stream(Version(MAX_LIFTED - 1))
    assert track.send((3,), versions) == MAX_LIFTED
    assert track.send((4,), versions) == MAX_LIFTED + 1, "on one stream they only grow"
