"""Applies changes to a set of peers, and merges two changes while neither has been sent.

Changes from version B to version V: `PeerSet(version=V, base=B, peers=new or different, removed=gone)`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from plr.protos.model.ids import Version
from plr.protos.model.members import POLICY_PENDING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from plr.protos.model.ids import NodeName
    from plr.protos.model.members import Peer, PeerSet


def put_upon(held: Mapping[NodeName, Peer], changes: PeerSet) -> PeerSet:
    """Return the whole set that these changes make of the peers of their base version, with the changes' notices."""
    peers = dict(held)
    _change(peers, changes)
    return replace(changes, peers=tuple(peers.values()), base=Version(0), more=False)


def put_together(first: PeerSet, then: PeerSet) -> PeerSet:
    """Return one set with the effect of both in turn; the base of the second is the version of the first, or 0."""
    if not then.base:
        return then
    peers = {peer.name: peer for peer in first.peers}
    _change(peers, then)
    gone = {removed.name: removed for removed in (*first.removed, *then.removed) if removed.name not in peers}
    # The first policy stays in force while the next one must not be applied yet.
    policy = first.policy if then.policy == POLICY_PENDING else then.policy
    return replace(then, base=first.base, peers=tuple(peers.values()), removed=tuple(gone.values()), policy=policy)


def _change(peers: dict[NodeName, Peer], changes: PeerSet) -> None:
    for removed in changes.removed:
        peers.pop(removed.name, None)
    for peer in changes.peers:
        peers[peer.name] = peer
