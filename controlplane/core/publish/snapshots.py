"""Tracks what each sidecar was sent, and whether it took it: versions, nonces, acks and nacks, as in xDS."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

from plr.protos.model.ids import MAX_VERSION, Version
from plr.protos.model.mapping import MappingSet
from plr.protos.model.members import POLICY_PENDING, PeerSet
from plr.protos.model.status import ResourceStatus, SyncState
from plr.protos.model.stream import ResourceKind

if TYPE_CHECKING:
    from plr.controlplane.core.publish.told_peers import ToldPeers
    from plr.protos.model.ids import NodeName
    from plr.protos.model.mapping import ServiceMapping
    from plr.protos.model.members import Peer, RemovedPeer
    from plr.protos.model.stream import Ack, Nack

C = TypeVar("C")


@dataclass(frozen=True, slots=True)
class PeerView:
    """What a sidecar is sent about its peers."""

    peers: tuple[Peer, ...]
    policy: int = POLICY_PENDING
    """The `policy` of PeerSet."""


MAX_LIFTED = 1 << 53
"""No control plane of ours gives out such a version: seconds since 1970 with 2^20 versions each are half of that in the
year 2100. A sidecar that says it holds one has it from a broken or hostile one, and begins again."""


class VersionSource:
    """Gives out versions that only grow, even over restarts, as `epoch` grows with wall-clock time."""

    def __init__(self, epoch: int) -> None:
        self._last = epoch

    def above(self, floor: Version) -> Version:
        """Return a new version, larger than `floor` and all given out before.

        A floor beyond the epoch (what a sidecar says it holds) lifts this sidecar's version alone, not everybody's.
        """
        self._last += 1
        return Version(min(max(self._last, floor + 1), MAX_VERSION))


class Track(Generic[C]):
    """One resource of one sidecar: what was last sent, and what became of it."""

    def __init__(self) -> None:
        self.sent: C | None = None
        """What was last sent, or None if the sidecar has to be sent everything."""
        self.nonce = 0
        self.state = SyncState.NOT_SENT
        """REJECTED stays while refused content is resent, until the sidecar has taken something."""
        self.version_sent = Version(0)
        self.version_acked = Version(0)
        self.error = ""
        self.send_again = False
        """Whether to send it although it equals `sent`: that was refused a while ago."""
        self.refused_as_before = False
        """Whether the last refusal gave the same reason as the one before, with nothing taken in between."""
        self._refusal: str | None = None
        self._unanswered = False
        self._floor = Version(0)

    def begin_stream(self, held: Version) -> None:
        """Begin a new stream: the sidecar says which version it holds; anything else sent may not have arrived."""
        # Versions of other streams mean something only to sidecars older than this control plane.
        self._floor = max(self.version_sent, held if held < MAX_LIFTED else Version(0))
        refused, self._unanswered = self.refused, False
        if self.sent is not None and held == self.version_sent and not refused:
            self.error = ""
            self.state = SyncState.SYNCED
            self.version_acked = held
            return
        self.sent = None
        self.state = SyncState.NOT_SENT
        self.version_acked = held
        self.error = ""
        self._refusal = None

    def send(self, content: C, versions: VersionSource) -> Version:
        """Note that `content` goes out; return its version. The nonce is the new `nonce`."""
        self.sent = content
        self.version_sent = self._floor = versions.above(self._floor)
        self.nonce += 1
        self._unanswered = True
        if not self.send_again:
            self.state = SyncState.STALE
            self.error = ""
        self.send_again = False
        return self.version_sent

    def ack(self, ack: Ack) -> bool:
        """Note that the sidecar applied it; return False if that is stale: about something earlier, or already
        refused."""
        if ack.nonce != self.nonce or ack.version != self.version_sent or not self._unanswered:
            return False
        self._unanswered = False
        self.state = SyncState.SYNCED
        self.error = ""
        self.version_acked = ack.version
        self._refusal = None
        return True

    def nack(self, nack: Nack) -> bool:
        """Note that the sidecar refused it; return False if that is stale."""
        if nack.nonce != self.nonce or not (self._unanswered or self.state is SyncState.SYNCED):
            return False
        self._unanswered = False
        self.state = SyncState.REJECTED
        self.version_acked = nack.version
        self.error = nack.error
        self.refused_as_before = nack.error == self._refusal
        self._refusal = nack.error
        return True

    @property
    def refused(self) -> bool:
        """Whether the sidecar refused what it was last sent, and has not been sent it again since."""
        return self.state is SyncState.REJECTED and not self._unanswered

    @property
    def status(self) -> ResourceStatus:
        """Status for the operator."""
        return ResourceStatus(self.version_sent, self.version_acked, self.state, self.error)


class Snapshots:
    """Both resources of one sidecar."""

    __slots__ = ("known_names", "mapped_at", "mapping", "peers", "sent_changes", "whole_again_at")

    def __init__(self) -> None:
        self.peers: Track[PeerView] = Track()
        self.mapping: Track[tuple[ServiceMapping, ...]] = Track()
        self.mapped_at = -math.inf
        """When the mapping was last sent."""
        self.known_names: set[NodeName] = set()
        """Peers the sidecar may know: of the set it last acknowledged and of all sent since."""
        self.sent_changes = False
        """Whether the last peers sent were changes to those before."""
        self.whole_again_at = -math.inf
        """Time from which a refusal of changes is answered at once with the whole set."""

    @property
    def base(self) -> Version:
        """What changes of the peers can build on: the version the sidecar holds or is about to; 0 if only all will do.

        Messages of a stream arrive in order. Had the sidecar refused what went before, it would refuse the changes.
        """
        track = self.peers
        usable = track.sent is not None and track.state is not SyncState.REJECTED and not track.send_again
        return track.version_sent if usable else Version(0)

    def send_peers(
        self, view: PeerView, told: ToldPeers, removed: tuple[RemovedPeer, ...], base: Version, versions: VersionSource
    ) -> PeerSet:
        """Send the sidecar its peers; `told` are those that it is sent: all of the view's, or the changes since `base`.

        `removed` names those that it may know and that the view does not have.
        """
        version = self.peers.send(view, versions)
        self.sent_changes = base > 0
        self.known_names.update(told.names())
        return PeerSet(version, self.peers.nonce, told, removed, view.policy, base)

    def send_mapping(self, services: tuple[ServiceMapping, ...], versions: VersionSource, now: float) -> MappingSet:
        """Send the sidecar its mapping."""
        self.mapped_at = now
        version = self.mapping.send(services, versions)
        return MappingSet(version, self.mapping.nonce, services)

    def track(self, resource: ResourceKind) -> Track[PeerView] | Track[tuple[ServiceMapping, ...]]:
        """Return one of the two."""
        return self.peers if resource is ResourceKind.PEERS else self.mapping

    def send_refused_again(self) -> bool:
        """Mark what is refused as due again, as wanted then, and as a new version. Return whether anything is."""
        for track in (self.peers, self.mapping):
            track.send_again = track.refused
        return self.peers.send_again or self.mapping.send_again

    def peers_acked(self, ack: Ack) -> bool:
        """Note that the sidecar applied its peers: it forgot all others."""
        if not self.peers.ack(ack):
            return False
        if self.peers.sent is not None:
            self.known_names = {peer.name for peer in self.peers.sent.peers}
        return True

    def wants_whole_now(self, now: float, again_s: float) -> bool:
        """Note that the peers were refused; return whether to send the whole set now, at most once in `again_s`
        seconds.

        Changes may be refused for lack of their base, and the whole set is then taken.
        """
        if not self.sent_changes or now < self.whole_again_at:
            return False
        self.whole_again_at = now + again_s
        self.peers.send_again = True
        return True
