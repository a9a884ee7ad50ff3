"""Checks what must always hold between a fleet and its control plane, for all members with no reason to lag.

- A sidecar holds what the control plane believes that it took, and what is true of the others.
- No member is owed the same version for long.
- No mapping names a server or an interface that has been gone for long.
- The registry holds the members that are there, and no others for long.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from plr.protos.model.ids import Role, Version
from plr.protos.model.members import NO_CALLS
from plr.protos.model.status import SyncState
from plr.protos.model.stream import ResourceKind
from plr.protos.trust.pair_token import pair_token

if TYPE_CHECKING:
    from collections.abc import Mapping

    from bench.fleetday.member import Member
    from bench.fleetday.plane import Plane
    from plr.controlplane.core.control.control import ControlCore
    from plr.controlplane.core.policy.policy import Policy
    from plr.protos.model.ids import NodeName
    from plr.protos.model.mapping import ServiceMapping
    from plr.protos.model.members import Peer

SETTLES_S = 60.0
"""Time after a change of a member, or of its reachability, until all that can learn of the change have: twice the
longest lease."""

GONE_S = 90.0
"""Time after a member's end until no healthy one knows it any more: the longest lease on top of SETTLES_S."""

STARTS_S = 120.0
"""Time after a start of the control plane until all members are back and everything is sent."""

MAX_COMPLAINTS = 200
"""Complaints kept; the others are only counted."""


@dataclass(frozen=True, slots=True)
class Belief:
    """What the control plane believes of one sidecar and one kind of resource."""

    state: SyncState
    version: Version
    """Version sent last."""


def believed(core: ControlCore, name: NodeName, resource: ResourceKind) -> Belief:
    """Return how far the control plane believes that a sidecar follows."""
    track = core._publisher[name].track(resource)
    return Belief(track.state, track.version_sent)


def believed_peers(core: ControlCore, name: NodeName) -> Mapping[NodeName, Peer] | None:
    """Return the peers that the control plane believes it sent a sidecar last, with their own tokens."""
    sent = core._publisher[name].peers.sent
    return {peer.name: peer for peer in sent.peers} if sent is not None else None


def believed_mapping(core: ControlCore, name: NodeName) -> tuple[ServiceMapping, ...] | None:
    """Return the mapping that the control plane believes it sent a robot last."""
    return core._publisher[name].mapping.sent


class Checker:
    """Compares the two sides repeatedly, and keeps what is wrong."""

    def __init__(self, plane: Plane, members: Mapping[NodeName, Member]) -> None:
        self._plane = plane
        self._members = members
        self.complaints: list[str] = []
        self.complaints_in_all = 0
        self.looks = 0
        self.judged = 0
        """Sidecars found healthy, summed over all comparisons."""
        self.compared = 0
        """Entries of peers compared with the belief or the truth."""
        self.policy_at = float("-inf")
        """When the policy last changed."""
        self._owed: dict[tuple[NodeName, ResourceKind], tuple[Version, float]] = {}
        """Versions that an earlier comparison found not taken, and since when."""

    def look(self, now: float) -> int:
        """Compare everything; return how many sidecars were judged."""
        self.looks += 1
        if not self._plane.up:
            return 0
        core = self._plane.core
        for member in self._members.values():
            for complaint in member.complaints:
                self._complain(now, complaint)
            member.complaints.clear()
        for member in self._members.values():
            self._belief(core, member, now)
        if now - max(self._plane.started_at, self.policy_at) < STARTS_S:
            return 0
        healthy = [member for member in self._members.values() if is_healthy(member, now)]
        self._registry(core, healthy, now)
        settled = [member for member in healthy if now - member.changed_at >= SETTLES_S]
        gone = {name for name, member in self._members.items() if is_gone(member, now)}
        by_role = {role: [member for member in settled if member.role is role] for role in Role}
        for member in healthy:
            other = Role.CLOUD if member.role is Role.ROBOT else Role.ROBOT
            self._truth(member, by_role[other], gone, now)
            self._owes(core, member, ResourceKind.PEERS, now)
            if member.role is Role.ROBOT:
                self._owes(core, member, ResourceKind.MAPPING, now)
                self._mapping(member, gone, now)
        self.judged += len(healthy)
        return len(healthy)

    def _complain(self, now: float, text: str) -> None:
        self.complaints_in_all += 1
        if len(self.complaints) < MAX_COMPLAINTS:
            self.complaints.append(f"{now / 3600.0:.3f} h: {text}")

    def _belief(self, core: ControlCore, member: Member, now: float) -> None:
        """Check that what counts as synced is in force at the member, and is what was sent."""
        known = core.registry.get(member.name)
        if known is None or not member.alive or known.registration.session != member.session_id:
            return
        peers = believed(core, member.name, ResourceKind.PEERS)
        if peers.state is SyncState.SYNCED:
            sent = believed_peers(core, member.name)
            if member.held.peers.version != peers.version:
                text = f"believed to hold peers {peers.version}, holds {member.held.peers.version}"
                self._complain(now, f"{member.name} {text}")
            elif sent is not None:
                self._same_peers(member, sent, now)
        mapping = believed(core, member.name, ResourceKind.MAPPING)
        if member.role is Role.ROBOT and mapping.state is SyncState.SYNCED:
            if member.held.mapping_version != mapping.version:
                text = f"believed to hold mapping {mapping.version}, holds {member.held.mapping_version}"
                self._complain(now, f"{member.name} {text}")
            elif _routes(member.held.mapping) != _routes(believed_mapping(core, member.name) or ()):
                self._complain(now, f"{member.name} holds another mapping than it was sent as {mapping.version}")

    def _same_peers(self, member: Member, sent: Mapping[NodeName, Peer], now: float) -> None:
        held = member.held.peers.table
        if held.keys() != sent.keys():
            odd = sorted(held.keys() ^ sent.keys())[:4]
            self._complain(now, f"{member.name} holds other peers than it is believed to: {odd}")
            return
        self.compared += len(held)
        for name, peer in held.items():
            if _said(peer) != _said(sent[name]):
                self._complain(now, f"{member.name} holds {name} otherwise than it is believed to")
            elif peer.token != pair_token(sent[name].token, member.name, member.role):
                self._complain(now, f"{member.name} holds a wrong token of {name}")

    def _registry(self, core: ControlCore, healthy: list[Member], now: float) -> None:
        for sidecar in core.registry:
            member = self._members.get(sidecar.name)
            if member is None or is_gone(member, now):
                self._complain(now, f"{sidecar.name} is registered, and gone for {GONE_S:g} s")
        for member in healthy:
            known = core.registry.get(member.name)
            if known is None or known.registration.session != member.session_id or known.stream is None:
                self._complain(now, f"{member.name} believes that it is registered, and is not")

    def _truth(self, holder: Member, others: list[Member], gone: set[NodeName], now: float) -> None:
        table = holder.held.peers.table
        policy = self._plane.policy
        for name in table.keys() & gone:
            self._complain(now, f"{holder.name} still holds {name}, which is gone")
        self.compared += len(others)
        for other in others:
            peer = table.get(other.name)
            if peer is None:
                if _concerned(policy, holder, other):
                    self._complain(now, f"{holder.name} does not hold {other.name}")
                continue
            if not _is_as(peer, other):
                self._complain(now, f"{holder.name} holds an older {other.name}")
            if not _may(policy, holder, other, peer):
                self._complain(now, f"{holder.name} holds {other.name} with other calls than the policy's")

    def _owes(self, core: ControlCore, member: Member, resource: ResourceKind, now: float) -> None:
        """Check that no healthy member is owed the same version for too long."""
        key = member.name, resource
        if core.registry.get(member.name) is None:
            return
        belief = believed(core, member.name, resource)
        nothing = resource is ResourceKind.MAPPING and not member.services.uses
        if belief.state is SyncState.SYNCED or nothing:
            self._owed.pop(key, None)
            return
        version, since = self._owed.get(key, (None, now))
        if version != belief.version:
            self._owed[key] = belief.version, now
        elif now - since >= SETTLES_S and member.ill_at < since:
            state = belief.state.value
            self._complain(now, f"{member.name} is {state} with its {resource.value} for {now - since:.0f} s")

    def _mapping(self, robot: Member, gone: set[NodeName], now: float) -> None:
        for mapping in robot.held.mapping:
            for assignment in mapping.assignments:
                if assignment.server in gone:
                    self._complain(now, f"{robot.name} is mapped to {assignment.server}, gone for {GONE_S:g} s")
                if now - robot.lost_at.get(assignment.interface, now) >= SETTLES_S:
                    self._complain(now, f"{robot.name} is mapped over {assignment.interface}, gone for {SETTLES_S:g} s")
        if now - robot.changed_at >= SETTLES_S:
            mapped = {mapping.service for mapping in robot.held.mapping}
            if mapped != {use.name for use in robot.services.uses}:
                self._complain(now, f"{robot.name} has a mapping for {sorted(mapped)}, not for what it carries")


def is_healthy(member: Member, now: float) -> bool:
    """Return whether nothing has recently kept a member from holding what it should."""
    return member.online and not (member.refuses or member.slow or member.draining) and now - member.ill_at >= SETTLES_S


def is_gone(member: Member, now: float) -> bool:
    """Return whether all should know by now that a member is gone."""
    return not member.alive and now - member.changed_at >= GONE_S


def _said(peer: Peer) -> tuple[object, ...]:
    """Return everything of a peer except its token."""
    return (
        *(peer.name, peer.role, peer.session, peer.incarnation, peer.candidates, peer.offers, peer.draining),
        *(peer.credential, peer.may_call, peer.candidates_serial, peer.candidates_signature),
    )


def _routes(mapping: tuple[ServiceMapping, ...]) -> list[object]:
    """Return a mapping without its prediction, which is rounded in transit."""
    return [(one.service, one.assignments, one.reason, one.explore) for one in mapping]


def _is_as(peer: Peer, member: Member) -> bool:
    """Return whether this matches what a member says of itself, whichever of its offers are sent."""
    return (
        (peer.session, peer.incarnation, peer.credential) == (member.session_id, member.incarnation, member.credential)
        and peer.candidates == member.candidates.candidates
        and peer.candidates_serial == member.candidates.serial
        and not peer.draining
        and set(peer.offers) <= set(member.services.offers)
    )


def _concerned(policy: Policy | None, one: Member, other: Member) -> bool:
    """Return whether the policy leaves the two anything to do with each other, given the cloud's present offers."""
    if policy is None:
        return True
    robot, cloud = (one, other) if one.role is Role.ROBOT else (other, one)
    return any(policy.allows(robot.name, offer.name, cloud.name) for offer in cloud.services.offers)


def _may(policy: Policy | None, holder: Member, other: Member, peer: Peer) -> bool:
    """Return whether the holder was sent exactly the calls that the current policy allows."""
    if holder.role is Role.CLOUD:
        if policy is None:
            return peer.may_call.everything
        offered = {offer.name for offer in holder.services.offers}
        allowed = {name for name in offered if policy.allows(other.name, name, holder.name)}
        return (
            not peer.may_call.everything
            and peer.may_call.services & offered == allowed
            and all(policy.allows(other.name, name, holder.name) for name in peer.may_call.services)
        )
    offers = {offer.name for offer in other.services.offers}
    allowed = {name for name in offers if policy is None or policy.allows(holder.name, name, other.name)}
    return peer.may_call == NO_CALLS and {offer.name for offer in peer.offers} == allowed
