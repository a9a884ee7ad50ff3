"""Sends each sidecar its peers and its mapping when they change, and keeps what came of it.

Warm-up. After a restart the registry is empty, while the robots continue with the peers they hold. A robot that says it
holds a version is therefore sent nothing until every server that its own reports name is back, or the warm-up is over:
a set without a server that is merely not back yet would cost the robot that server. Robots that hold nothing, and
clouds (they find their robots by the robots' own probes), are served at once. Nor are sets judged by the policy before
the warm-up is over (PeerSet.policy): a peer that is merely not back yet would be taken for one that the policy leaves
nothing to do.

Changes. A sidecar that takes changes of its peers is sent those that are new or different since what it was sent
before, on the same stream or, as it says when it registers, on an earlier one. At a gap, that is if it refuses, it is
sent all of them.

Who is examined. A robot's change is news to that robot and to the clouds; a change of a cloud or of the policy is news
to everybody. The others are not examined.

Refusals. A sidecar refuses what it cannot hold at the moment: its interface went and is back, its driver hung. That
passes, and what it is to hold need not change because of it. So refused content is sent again until it is taken.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING

from plr.controlplane.core.publish import mappings
from plr.controlplane.core.publish.messages import SendMessage
from plr.controlplane.core.publish.snapshots import PeerView, Snapshots, VersionSource
from plr.controlplane.core.publish.told_peers import ToldPeers
from plr.controlplane.core.publish.views import KnownPeers, Views
from plr.protos.model.ids import Role, Version
from plr.protos.model.members import MAX_SIDECARS, POLICY_PENDING
from plr.protos.model.stream import ResourceKind

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from plr.controlplane.core.formulation.block import Picture
    from plr.controlplane.core.policy.permits import Permits
    from plr.controlplane.core.problem.plan import Plan
    from plr.controlplane.core.registry.registry import Registry, Sidecar, StreamId
    from plr.protos.model.ids import NodeName
    from plr.protos.model.members import Registration
    from plr.protos.model.status import SyncState
    from plr.protos.model.stream import Ack, Nack

MAX_GONE_SNAPSHOTS = MAX_SIDECARS
"""Sidecars that left whose last set is remembered, for the notices when they return; the oldest are evicted."""

RESEND_S = 5.0
"""Interval at which refused content is resent: a passing cause is cured within seconds, and a set of a hundred peers (1
kB each) that is refused permanently takes 20 kB/s of a cellular link."""


INFORM_S = 5.0
"""Time after a mapping in which a robot is not sent one that merely reads differently: nothing acts on that, and the
prediction of a robot that has just come changes with each of its first reports."""


class Publisher:
    """The snapshots of all sidecars, those registered and the last ones that left."""

    def __init__(self, registry: Registry, *, version_epoch: int, warm_until: float | None) -> None:
        self._registry = registry
        self._versions = VersionSource(version_epoch)
        self._known_peers = KnownPeers()
        self._snapshots: dict[NodeName, Snapshots] = {}
        self._gone: OrderedDict[NodeName, Snapshots] = OrderedDict()
        self.warm_until = warm_until
        """When the warm-up ends; None once it is over."""
        self._held_back: dict[NodeName, frozenset[NodeName] | None] = {}
        """Robots held back, and the servers that they wait for; None before their first report."""
        self.resend_at: float | None = None
        """When to `send_refused_again`, to all in one go; None while nothing is refused."""
        self.inform_at: float | None = None
        """When to `inform`; None while there is nobody to inform."""
        self._uninformed: set[NodeName] = set()
        """Robots whose mapping reads differently by now."""
        self._due: set[NodeName] = set()
        """Sidecars to examine for news with the next `publish`."""
        self._clouds_due = False
        self._all_due = False

    def __getitem__(self, name: NodeName) -> Snapshots:
        return self._snapshots[name]

    def begin_stream(self, registration: Registration) -> None:
        """Note that a registered sidecar has a new stream."""
        name = registration.name
        snapshots = self._snapshots.get(name) or self._gone.pop(name, None) or Snapshots()
        self._snapshots[name] = snapshots
        snapshots.peers.begin_stream(registration.peers_version)
        snapshots.mapping.begin_stream(registration.mapping_version)
        self.changed(name, registration.role)
        holds = max(registration.peers_version, registration.mapping_version)
        if registration.role is Role.ROBOT and holds and self.warm_until is not None and not snapshots.known_names:
            self._held_back[name] = None

    def changed(self, name: NodeName, role: Role) -> None:
        """Note that what this sidecar is sent, or what others are sent about it, may have changed."""
        self._due.add(name)
        if role is Role.CLOUD:
            self._all_due = True
        else:
            self._clouds_due = True

    def all_changed(self) -> None:
        """Note that what everybody is told may have changed."""
        self._all_due = True

    def forget(self, name: NodeName, role: Role) -> None:
        """Note that a sidecar is no longer registered."""
        self.changed(name, role)
        self._held_back.pop(name, None)
        self._uninformed.discard(name)
        self._known_peers.forget(name)
        gone = self._gone[name] = self._snapshots.pop(name)
        gone.peers.sent = None  # a server's holds all robots as they were then
        if len(self._gone) > MAX_GONE_SNAPSHOTS:
            self._gone.popitem(last=False)

    def waits(self, name: NodeName) -> bool:
        """Return whether a robot is held back."""
        return name in self._held_back

    def release(self) -> bool:
        """Release the robots whose servers are all back; return whether there are any."""
        returned = [
            name for name, servers in self._held_back.items() if servers is not None and self._are_back(servers)
        ]
        for name in returned:
            del self._held_back[name]
        self._due.update(returned)
        return bool(returned)

    def _are_back(self, servers: Iterable[NodeName]) -> bool:
        known = (self._registry.get(server) for server in servers)
        return all(other is not None and other.ready for other in known)

    def waits_for(self, name: NodeName, servers: Iterable[NodeName]) -> bool:
        """Note that a robot reports on these servers; return True if it is held back."""
        if name not in self._held_back:
            return False
        self._held_back[name] = frozenset(servers)
        return True

    def end_warm_up(self) -> None:
        """End the warm-up: sidecars not back now are gone."""
        self.warm_until = None
        self._held_back.clear()
        self.all_changed()

    def acked(self, name: NodeName, ack: Ack) -> bool:
        """Note that a sidecar applied what it was sent; return False if that is stale."""
        snapshots = self._snapshots[name]
        return snapshots.peers_acked(ack) if ack.resource is ResourceKind.PEERS else snapshots.mapping.ack(ack)

    def nacked(self, name: NodeName, nack: Nack, now: float) -> bool:
        """Note that a sidecar refused what it was sent; return False if that is stale."""
        snapshots = self._snapshots[name]
        if not snapshots.track(nack.resource).nack(nack):
            return False
        if nack.resource is ResourceKind.PEERS and snapshots.wants_whole_now(now, RESEND_S):
            self._due.add(name)
        elif self.resend_at is None:
            self.resend_at = now + RESEND_S
        return True

    def is_due(self, name: NodeName) -> bool:
        """Return whether there may be news for this sidecar in particular."""
        return name in self._due

    def send_refused_again(self) -> None:
        """Send refused content with the next `publish`; the next refusal sets the time again."""
        self.resend_at = None
        for name, snapshots in self._snapshots.items():
            if snapshots.send_refused_again():
                self._due.add(name)

    def inform(self) -> None:
        """Examine robots whose mapping merely reads differently with the next `publish`."""
        self.inform_at = None
        self._due.update(self._uninformed)
        self._uninformed.clear()

    def publish(self, permits: Permits, plan: Plan, picture: Picture, now: float) -> Iterator[SendMessage | None]:
        """Yield everything that is news to somebody, and None before each sidecar, for other work in between: several
        times if it has many peers.

        Clouds come first: what a robot learns that it may call must be refused nowhere.
        """
        views = Views(self._registry, permits, self._known_peers)
        for name in self._take_due():
            sidecar = self._registry.get(name)
            yield from views.looks(sidecar)
            if sidecar is None or sidecar.stream is None or self._is_held_back(sidecar, permits):
                continue
            yield from self._peers(sidecar, sidecar.stream, views, permits)
            if sidecar.role is Role.ROBOT:
                yield from self._mapping(sidecar, sidecar.stream, views, plan, picture, now)

    def _take_due(self) -> list[NodeName]:
        """Return whom to examine now, clouds first."""
        everybody, clouds = self._all_due, self._all_due or self._clouds_due
        due = self._due
        self._due, self._clouds_due, self._all_due = set(), False, False
        clouds_due: list[NodeName] = []
        robots_due: list[NodeName] = []
        for sidecar in self._registry:
            if sidecar.role is Role.CLOUD:
                if clouds or sidecar.name in due:
                    clouds_due.append(sidecar.name)
            elif everybody or sidecar.name in due:
                robots_due.append(sidecar.name)
        return clouds_due + robots_due

    def plan_changed(self, robots: Iterable[NodeName]) -> None:
        """Note that the mappings of these robots may be news with the next `publish`."""
        self._due.update(robots)

    def publish_plan(
        self, robots: Iterable[NodeName], permits: Permits, plan: Plan, picture: Picture, now: float
    ) -> Iterator[SendMessage | None]:
        """Yield the mappings of these robots that are news; the members have not changed since `publish`."""
        views = Views(self._registry, permits, self._known_peers)
        for name in robots:
            robot = self._registry.get(name)
            yield from views.looks(robot)
            if robot is not None and robot.stream is not None and not self._is_held_back(robot, permits):
                yield from self._mapping(robot, robot.stream, views, plan, picture, now)

    def _is_held_back(self, sidecar: Sidecar, permits: Permits) -> bool:
        if permits.restricted and sidecar.role is Role.CLOUD and not sidecar.ready:
            # What robots may call on it depends on what it offers.
            return True
        return self.waits(sidecar.name)

    def _peers(self, sidecar: Sidecar, stream: StreamId, views: Views, permits: Permits) -> Iterator[SendMessage]:
        snapshots = self._snapshots[sidecar.name]
        judged = self.warm_until is None or not permits.restricted
        view = PeerView(views.peers_of(sidecar), permits.fingerprint if judged else POLICY_PENDING)
        sent = snapshots.peers.sent
        if not snapshots.peers.send_again and view == sent:
            return
        base = snapshots.base if sidecar.registration.incremental else Version(0)
        peers = views.changes(sent.peers, sidecar) if base and sent is not None else view.peers
        told = ToldPeers(peers, sidecar.name, sidecar.role)
        removed = views.removed(sidecar, snapshots.known_names)
        yield SendMessage(stream, snapshots.send_peers(view, told, removed, base, self._versions))

    def _mapping(
        self, robot: Sidecar, stream: StreamId, views: Views, plan: Plan, picture: Picture, now: float
    ) -> Iterator[SendMessage]:
        snapshots = self._snapshots[robot.name]
        sent = snapshots.mapping.sent
        mapping = mappings.mapping_of(robot, views.servers_of(robot.name), plan, picture, sent or ())
        if sent is None:
            # Having nothing to say yet is no reason to take away what the sidecar holds from before.
            worth_sending = bool(mapping)
        else:
            worth_sending = snapshots.mapping.send_again or mappings.differs(mapping, sent)
            if not worth_sending and mappings.reads_differently(mapping, sent):
                inform_at = snapshots.mapped_at + INFORM_S
                worth_sending = inform_at <= now
                if not worth_sending:
                    self._uninformed.add(robot.name)
                    self.inform_at = min(inform_at, self.inform_at or inform_at)
        if worth_sending:
            yield SendMessage(stream, snapshots.send_mapping(mapping, self._versions, now))

    def sync_states(self) -> Iterator[tuple[NodeName, ResourceKind, SyncState]]:
        """Yield how far every registered sidecar follows; clouds get no mapping."""
        for sidecar in self._registry:
            snapshots = self._snapshots[sidecar.name]
            yield sidecar.name, ResourceKind.PEERS, snapshots.peers.state
            if sidecar.role is Role.ROBOT:
                yield sidecar.name, ResourceKind.MAPPING, snapshots.mapping.state
