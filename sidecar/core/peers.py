"""The peers this sidecar may talk to: the control plane's view, corrected by what the paths themselves prove.

A peer that merely vanished from the view (its lease ran out, or the control plane restarted with an empty registry)
is kept while a path to it lives: a dead control plane must not cost a request. One that left, was revoked or is kept
away by the access policy goes at once; so does every one that vanished when the policy changes, since nobody said what
it may do under the new one.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from protos.model import NO_POLICY, POLICY_PENDING, PeerSet, RemovalReason, Version
from sidecar.core.link_events import LinkPeer

if TYPE_CHECKING:
    from collections.abc import Callable

    from protos.model import Address, InterfaceId, NodeName, Peer, ServiceName, SessionId
    from sidecar.core.link_events import PeerRestarted

MAX_PEERS = 4096
"""Peers kept; a control plane that names more is refused."""
RESTART_GAP_S = 1.0
"""A peer that says more often that it restarted is not believed: every restart costs all links work."""


class Peers:
    """Known peers by name."""

    def __init__(self) -> None:
        self._known: dict[NodeName, Peer] = {}
        self._unlisted: set[NodeName] = set()
        self._restarted_at: dict[NodeName, float] = {}
        self._policy = NO_POLICY
        """Fingerprint of the access policy that was judged by last."""
        self.version = Version(0)

    def __contains__(self, name: object) -> bool:
        return name in self._known

    def names(self) -> list[NodeName]:
        """Return the names of all known peers."""
        return list(self._known)

    def get(self, name: NodeName) -> Peer | None:
        """Return a peer by name."""
        return self._known.get(name)

    def all(self) -> list[Peer]:
        """Return all known peers."""
        return list(self._known.values())

    def apply(self, peer_set: PeerSet, reaches: Callable[[NodeName], bool]) -> str | None:
        """Take a new view; returns why it is refused, or None. `reaches` tells whether a path to a peer lives."""
        if len(peer_set.peers) > MAX_PEERS:
            return f"{len(peer_set.peers)} peers, the limit is {MAX_PEERS}"
        if len({peer.session for peer in peer_set.peers}) != len(peer_set.peers):
            return "two peers share a session"
        gone = {removed.name for removed in peer_set.removed if removed.reason is not RemovalReason.LEASE_EXPIRED}
        sessions = {peer.session for peer in peer_set.peers}
        known = {peer.name: self._newer(peer, sessions) for peer in peer_set.peers}
        unlisted = set()
        new_policy = peer_set.policy not in (POLICY_PENDING, NO_POLICY, self._policy)
        for name, peer in self._known.items():
            if new_policy or name in known or name in gone or peer.session in sessions or len(known) >= MAX_PEERS:
                continue
            if reaches(name):
                known[name] = peer
                unlisted.add(name)
        self._known = known
        self._restarted_at = {name: at for name, at in self._restarted_at.items() if name in known}
        self._unlisted = unlisted
        if peer_set.policy != POLICY_PENDING:
            self._policy = peer_set.policy
        self.version = peer_set.version
        return None

    def _newer(self, listed: Peer, sessions: set[SessionId]) -> Peer:
        """The view may be older than what the peer itself proved by its HELLO; `sessions` are the view's."""
        known = self._known.get(listed.name)
        if known is None or known.token != listed.token or known.session in sessions:
            return listed
        if known.incarnation > listed.incarnation:
            return dataclasses.replace(listed, session=known.session, incarnation=known.incarnation)
        return listed

    def restarted(self, event: PeerRestarted, now: float) -> bool:
        """Take a peer's newer session; False when it is not newer, or comes too soon after the one before."""
        peer = self._known.get(event.peer)
        if peer is None or event.incarnation <= peer.incarnation:
            return False
        restarted_at = self._restarted_at.get(event.peer)
        if restarted_at is not None and now < restarted_at + RESTART_GAP_S:
            return False
        if any(other.session == event.session for other in self._known.values()):
            return False
        self._restarted_at[event.peer] = now
        self._known[event.peer] = dataclasses.replace(peer, session=event.session, incarnation=event.incarnation)
        return True

    def drop_if_unlisted(self, name: NodeName) -> bool:
        """The last path to a peer died: True when that ends it, because the view no longer lists it."""
        if name not in self._unlisted:
            return False
        self._unlisted.discard(name)
        self._restarted_at.pop(name, None)
        del self._known[name]
        return True

    def may_call(self, name: NodeName, service: ServiceName) -> bool:
        """Cloud: whether the control plane lets this robot call the service here; not if it is unknown."""
        peer = self._known.get(name)
        return peer is not None and service in peer.may_call

    def session(self, name: NodeName) -> SessionId | None:
        """Return a peer's session."""
        peer = self._known.get(name)
        return None if peer is None else peer.session

    def for_links(self) -> tuple[LinkPeer, ...]:
        """Return the peers as links need them."""
        return tuple(_link_peer(peer) for peer in self._known.values())


def _link_peer(peer: Peer) -> LinkPeer:
    by_interface: dict[InterfaceId, list[Address]] = {}
    for candidate in peer.candidates:
        addresses = by_interface.setdefault(candidate.interface_id, [])
        if candidate.address not in addresses:
            addresses.append(candidate.address)
    return LinkPeer(
        peer.name,
        peer.session,
        peer.token,
        peer.incarnation,
        tuple((interface, tuple(addresses)) for interface, addresses in sorted(by_interface.items())),
    )
