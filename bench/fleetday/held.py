"""Tracks what a sidecar holds after it has applied what it was sent: its peers and its mapping.

Only `HeldPeers.apply` knows how a message changes that; checks use the table.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.protos.model.ids import Version

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from plr.protos.model.ids import NodeName
    from plr.protos.model.mapping import ServiceMapping
    from plr.protos.model.members import Peer, PeerSet


class HeldPeers:
    """The peers in force at one sidecar."""

    def __init__(self) -> None:
        self.version = Version(0)
        self._told: Sequence[Peer] = ()
        self._table: dict[NodeName, Peer] | None = {}

    def apply(self, message: PeerSet) -> None:
        """Put a set into force. A whole set is read only on demand: few sets of a large fleet ever are."""
        self.version = message.version
        self._told = message.peers
        self._table = None

    @property
    def table(self) -> Mapping[NodeName, Peer]:
        """The peers by name."""
        if self._table is None:
            self._table = {peer.name: peer for peer in self._told}
        return self._table


class Held:
    """Everything in force at one sidecar; it survives restarts if the disk does."""

    def __init__(self) -> None:
        self.peers = HeldPeers()
        self.mapping: tuple[ServiceMapping, ...] = ()
        self.mapping_version = Version(0)
