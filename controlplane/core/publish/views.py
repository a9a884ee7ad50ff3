"""Computes what each sidecar is sent about the others: those of the other role that are ready, as far as the policy
allows contact with them. Views are made for one publication, so that what many are sent alike is made once.

- A robot is sent the clouds on which it may call something, with the offers it may call.
- A cloud is sent the robots that may call something on it, each with what that is.
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import TYPE_CHECKING

from plr.protos.model.ids import Role
from plr.protos.model.members import ALL_CALLS, RemovalReason, RemovedPeer

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence

    from plr.controlplane.core.policy.permits import Group, Permits
    from plr.controlplane.core.registry.registry import Registry, Sidecar
    from plr.protos.model.ids import NodeName
    from plr.protos.model.members import CallPermit, Peer


MAX_PERMITS_KEPT = 64
"""Permits kept per sidecar; clouds covered by the same rules have the same."""

PEERS_OF_A_LOOK = 16
"""Peers that make a sidecar as costly to examine as one without any."""


class KnownPeers:
    """Sidecars as announced to their peers, kept from one publication to the next: nearly all stay as they were.

    So they are the same objects, and two views are compared by identity, without a look inside.
    """

    def __init__(self) -> None:
        self._made: dict[NodeName, tuple[Sidecar, dict[CallPermit, Peer]]] = {}
        self._former: dict[NodeName, tuple[Sidecar, dict[CallPermit, Peer]]] = {}
        """Those made under the former permits: most hold under the present ones; the others go with the next ones."""
        self._permits: Permits | None = None

    def under(self, permits: Permits) -> None:
        """Note that these permits are in force."""
        if permits is not self._permits:
            self._permits = permits
            self._former, self._made = self._made, {}

    def peer(self, sidecar: Sidecar, permit: CallPermit) -> Peer:
        """Return a robot that has this permit, or a cloud as told to those who have it there."""
        made = self._made.get(sidecar.name)
        if made is None or made[0] is not sidecar:
            made = self._made[sidecar.name] = sidecar, {}
        peer = made[1].get(permit)
        if peer is None:
            if len(made[1]) >= MAX_PERMITS_KEPT:
                made[1].clear()
            former = self._former.get(sidecar.name)
            known = former[1].get(permit) if former is not None and former[0] is sidecar else None
            peer = made[1][permit] = known if known is not None else _as_told(sidecar, permit)
        return peer

    def forget(self, name: NodeName) -> None:
        """Note that it is no longer registered."""
        self._made.pop(name, None)
        self._former.pop(name, None)


def _as_told(sidecar: Sidecar, permit: CallPermit) -> Peer:
    peer = sidecar.as_peer()
    if sidecar.role is Role.ROBOT:
        return dataclasses.replace(peer, may_call=permit)
    return dataclasses.replace(peer, offers=tuple(offer for offer in peer.offers if offer.name in permit))


class Views:
    """The views of all sidecars at one moment."""

    def __init__(self, registry: Registry, permits: Permits, known: KnownPeers) -> None:
        self._known = known
        known.under(permits)
        self._registry = registry
        self._permits = permits
        ready = sorted((sidecar for sidecar in registry if sidecar.ready), key=lambda sidecar: sidecar.name)
        self._robots = [sidecar for sidecar in ready if sidecar.role is Role.ROBOT]
        self._clouds = [sidecar for sidecar in ready if sidecar.role is Role.CLOUD]
        self._of_robots: dict[Group, tuple[Peer, ...]] = {}
        self._of_clouds: dict[NodeName, tuple[Peer, ...]] = {}
        self._permitted: dict[tuple[CallPermit, ...], tuple[Peer, ...]] = {}
        self._changes: dict[tuple[int, int], tuple[tuple[Peer, ...], tuple[Peer, ...]]] = {}
        """By the identities of a former and a present view: the former one, to keep it alive, and the differences."""
        self._servers: dict[Group, Mapping[NodeName, CallPermit]] = {}

    def looks(self, sidecar: Sidecar | None) -> Iterator[None]:
        """Yield once, and once more for every PEERS_OF_A_LOOK peers that a sidecar may have."""
        peers: Sequence[Sidecar] = ()
        if sidecar is not None:
            peers = self._robots if sidecar.role is Role.CLOUD else self._clouds
        return itertools.repeat(None, 1 + len(peers) // PEERS_OF_A_LOOK)

    def peers_of(self, sidecar: Sidecar) -> tuple[Peer, ...]:
        """Return the peers a sidecar is sent, by name."""
        if sidecar.role is Role.CLOUD:
            if sidecar.name not in self._of_clouds:
                self._of_clouds[sidecar.name] = self._robots_for(sidecar)
            return self._of_clouds[sidecar.name]
        group = self._permits.group(sidecar.name)
        peers = self._of_robots.get(group)
        if peers is None:
            servers = self.servers_of(sidecar.name)
            clouds = ((cloud, servers.get(cloud.name)) for cloud in self._clouds)
            peers = tuple(self._known.peer(cloud, permit) for cloud, permit in clouds if permit is not None)
            self._of_robots[group] = peers
        return peers

    def servers_of(self, robot: NodeName) -> Mapping[NodeName, CallPermit]:
        """Return the clouds a robot is sent, and what it may call there."""
        group = self._permits.group(robot)
        servers = self._servers.get(group)
        if servers is None:
            found = ((cloud.name, self._permits.of(group, cloud)) for cloud in self._clouds)
            servers = self._servers[group] = {name: permit for name, permit in found if permit}
        return servers

    def _robots_for(self, cloud: Sidecar) -> tuple[Peer, ...]:
        if self._permits.restricted:
            permits = tuple(self._permits.of(self._permits.group(robot.name), cloud) for robot in self._robots)
        else:
            permits = (ALL_CALLS,) * len(self._robots)
        peers = self._permitted.get(permits)
        if peers is None:
            pairs = zip(self._robots, permits, strict=True)
            peers = tuple(self._known.peer(robot, permit) for robot, permit in pairs if permit)
            self._permitted[permits] = peers
        return peers

    def changes(self, before: tuple[Peer, ...], sidecar: Sidecar) -> tuple[Peer, ...]:
        """Return the peers of a sidecar that have changed since it was told `before`."""
        peers = self.peers_of(sidecar)
        found = self._changes.get((id(before), id(peers)))
        if found is None:
            old = {peer.name: peer for peer in before}
            changed = tuple(peer for peer in peers if (was := old.get(peer.name)) is not peer and was != peer)
            found = self._changes[id(before), id(peers)] = before, changed
        return found[1]

    def removed(self, sidecar: Sidecar, known_names: Collection[NodeName]) -> tuple[RemovedPeer, ...]:
        """Return notices, by name, on those a sidecar may know and should no longer list, with the reason."""
        present = {peer.name for peer in self.peers_of(sidecar)}
        return tuple(
            RemovedPeer(name, self._reason(sidecar, name)) for name in sorted(known_names) if name not in present
        )

    def _reason(self, sidecar: Sidecar, name: NodeName) -> RemovalReason:
        other = self._registry.get(name)
        if other is None or not other.ready:
            return self._registry.removal_reason(name)
        cloud = other if other.role is Role.CLOUD else sidecar
        # A cloud that has not offered anything yet forbids nothing: it may be on its way back.
        return RemovalReason.FORBIDDEN if cloud.offered else RemovalReason.LEASE_EXPIRED
