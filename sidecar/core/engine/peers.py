"""Holds the peers this sidecar may talk to: the control plane's view, corrected by what the paths themselves prove.

A peer is known by its credential, which this sidecar judges itself (`OwnSession.admit`): one whose credential is bad
is no peer, whatever the control plane says. It is still kept for later judgements: a corrected clock or a new CA may
prove it good, and the control plane, for which the view is in force, does not send it again. The addresses of a peer
are those that it signed itself (`announced.py`).

A peer that merely vanished from the view (its lease ran out, or the control plane restarted with an empty registry)
is kept: a dead control plane must not cost a request. While a path to it lives, it stays a peer. Without one it is
dormant (`dormant.py`): it gets nothing, but is answered when it talks again. One that left, was revoked or is kept away
by the access policy goes at once. So does every vanished peer when the policy changes, since nobody has said what it
may do under the new one.
"""

from __future__ import annotations

import contextlib
import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import Role, Version
from plr.protos.model.members import MAX_PEERS, NO_POLICY, POLICY_PENDING, PeerSet, RemovalReason
from plr.protos.trust.identity import EXPIRED, LIST_TOO_OLD, NOT_YET_VALID, CertificateError
from plr.sidecar.core.engine.announced import Announced
from plr.sidecar.core.engine.dormant import Dormant, DormantPeers
from plr.sidecar.core.engine.verification_budget import VerificationBudget
from plr.sidecar.core.seam.links import LinkPeer

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Callable, Container, Iterable

    from plr.protos.model.ids import Address, InterfaceId, NodeName, ServiceName, SessionId
    from plr.protos.model.members import Peer
    from plr.sidecar.core.crypto.key_schedule import PairKeys
    from plr.sidecar.core.crypto.session import OwnSession
    from plr.sidecar.core.seam.links import PeerRenewed, PeerRestarted

MATTERS_OF_TIME = frozenset({EXPIRED, NOT_YET_VALID, LIST_TOO_OLD})
"""Faults of a credential that may be faults of this host's clock."""
RESTART_GAP_S = 1.0
"""A peer that restarts more often is not believed: every restart costs all links work. The cost of verifying
credentials that claim a restart has a budget of its own (`verification_budget.py`)."""


@dataclass(frozen=True, slots=True)
class RefusedPeer:
    """A peer of the view whose credential is bad."""

    peer: Peer
    why: str
    cause: str
    """Stays the same while the cause does: `why` may contain seconds that change."""

    @staticmethod
    def of(peer: Peer, error: DecodeError) -> RefusedPeer:
        """Return the refusal of a peer whose judgement raised `error`."""
        return RefusedPeer(peer, str(error), error.reason if isinstance(error, CertificateError) else str(error))


class Peers:
    """Known peers by name."""

    def __init__(self, own: OwnSession, dropped: Counter[str]) -> None:
        self._own = own
        self._dropped = dropped
        self._known: dict[NodeName, Peer] = {}
        self._keys: dict[NodeName, PairKeys] = {}
        """Keys shared with each peer."""
        self.refused: dict[NodeName, RefusedPeer] = {}
        """Refused peers of the view, so no more than `MAX_PEERS`."""
        self._announced = Announced(own, dropped)
        self._unlisted: set[NodeName] = set()
        self._dormant = DormantPeers(own.credential.role, dropped)
        self._told: dict[NodeName, tuple[Peer, PairKeys, LinkPeer]] = {}
        """What links were told about each peer, and what that was made from."""
        self._restarted_at: dict[NodeName, float] = {}
        self._budget = VerificationBudget()
        self._policy = NO_POLICY
        """Fingerprint of the last access policy applied."""
        self.ended_by_policy: frozenset[NodeName] = frozenset()
        """The peers that the last view did not list, and that were forgotten because it has another policy."""
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

    def all_held(self) -> list[Peer]:
        """Return all known peers and the dormant ones, which are judged with them."""
        return [*self._known.values(), *(dormant.peer for dormant in self._dormant.all())]

    def all_kept(self) -> set[NodeName]:
        """Return the names of those that are kept although the view does not list them, in whatever state."""
        kept = (*(dormant.peer for dormant in self._dormant.all()), *self._dormant.aside())
        return self._unlisted.union(peer.name for peer in kept)

    def is_unlisted(self, name: NodeName) -> bool:
        """Return whether this is a peer for its living paths only, as the view does not list it."""
        return name in self._unlisted

    def is_dormant(self, name: NodeName) -> bool:
        """Return whether the peer is dormant."""
        return name in self._dormant

    def apply(self, peer_set: PeerSet, reaches: Callable[[NodeName], bool]) -> str | None:
        """Take a new view; return why it is refused, or None. `reaches` returns whether a path to a peer lives."""
        if len(peer_set.peers) > MAX_PEERS:
            return f"{len(peer_set.peers)} peers, the limit is {MAX_PEERS}"
        gone = {removed.name for removed in peer_set.removed if removed.reason is not RemovalReason.LEASE_EXPIRED}
        new_policy = peer_set.policy not in (POLICY_PENDING, NO_POLICY, self._policy)
        newest = [(self._newer(listed), listed) for listed in peer_set.peers]
        proven = {peer.session: peer.name for peer, listed in newest if peer.session != listed.session}
        if not new_policy:
            proven |= self._sessions_besides(gone.union(listed.name for listed in peer_set.peers))
        known: dict[NodeName, Peer] = {}
        keys: dict[NodeName, PairKeys] = {}
        refused: dict[NodeName, RefusedPeer] = {}
        for peer, listed in newest:
            owner = proven.get(peer.session, peer.name)
            if owner != peer.name:
                # With certificates the number follows from the key (`credential.verify`). Without, anybody may take it.
                why = f"it has the session number of {owner}, which proved that the number is its own"
                refused[peer.name] = RefusedPeer(peer, why, why)
                self._dropped["session_taken"] += 1
                continue
            try:
                keys[peer.name] = self._own.admit(peer)
                known[peer.name] = self._at_announced(peer, listed)
            except DecodeError as error:
                refused[peer.name] = RefusedPeer.of(peer, error)
                self._dropped["bad_credential"] += 1
        # Refused peers do not count: only the control plane vouches for their sessions.
        sessions = {peer.session for peer in known.values()}
        if len(sessions) != len(known):
            return "two peers share a session"
        self.refused = refused
        unlisted = set()
        over = gone | known.keys() | refused.keys()

        def may_not_return(peer: Peer) -> bool:
            return new_policy or peer.name in over

        others = self._sessions_besides(over).values() if new_policy else ()
        self.ended_by_policy = frozenset(others)
        self._dormant.drop(may_not_return)
        for name, peer in self._known.items():
            if may_not_return(peer):
                continue
            if reaches(name) and len(known) < MAX_PEERS:
                known[name], keys[name] = peer, self._keys[name]
                unlisted.add(name)
            else:
                self._dormant.put(Dormant(peer, self._keys[name]))
        self._dormant.make_room(len(known))
        self._known, self._keys = known, keys
        self._announced.forget_all_but(set(known))
        held = {peer.name for peer in self.all_held()}
        self._restarted_at = {name: at for name, at in self._restarted_at.items() if name in held}
        self._budget.keep(known)  # the dormant ones too, until their buckets are full
        self._unlisted = unlisted
        if peer_set.policy != POLICY_PENDING:
            self._policy = peer_set.policy
        self.version = peer_set.version
        return None

    def _sessions_besides(self, names: Container[NodeName]) -> dict[SessionId, NodeName]:
        """Return the sessions of all peers that are kept, except those of these names."""
        kept = (*self.all_held(), *self._dormant.aside())
        return {peer.session: peer.name for peer in kept if peer.name not in names}

    @property
    def ignored_candidates(self) -> dict[NodeName, str]:
        """Return the peers whose addresses in the view are not used, and why."""
        return self._announced.ignored

    def _at_announced(self, peer: Peer, told: Peer) -> Peer:
        """Return the peer with the addresses to use, now that the view describes it as `told`."""
        candidates = self._announced.candidates_of(told)
        return peer if candidates == peer.candidates else dataclasses.replace(peer, candidates=candidates)

    def _newer(self, listed: Peer) -> Peer:
        """Return the newer of a listed peer and what it proved by its introduction: the view may be older."""
        known = self._held(listed.name)
        if known is None or known.token != listed.token or known.credential == listed.credential:
            return listed
        if (known.session, known.incarnation) == (listed.session, listed.incarnation):
            renewed = self._ends_at(known) > self._ends_at(listed)
            return dataclasses.replace(listed, credential=known.credential) if renewed else listed
        if known.incarnation > listed.incarnation:
            return dataclasses.replace(
                listed, session=known.session, incarnation=known.incarnation, credential=known.credential
            )
        return listed

    def restarted(self, event: PeerRestarted, now: float) -> bool:
        """Take a peer's newer session; False when it is not newer or proven, or comes too soon after another."""
        name, credential = event.peer, event.credential
        peer = self._held(name)
        if peer is None or credential.incarnation <= peer.incarnation:
            return False
        restarted_at = self._restarted_at.get(name)
        if restarted_at is not None and now < restarted_at + RESTART_GAP_S:
            return False
        if self._has_session(credential.session):
            return False
        newer = dataclasses.replace(
            peer, session=credential.session, incarnation=credential.incarnation, credential=credential.encode()
        )
        if not self._introduced(newer, now, at_home=event.at_home):
            return False
        self._restarted_at[name] = now
        return True

    def renewed(self, event: PeerRenewed, now: float) -> bool:
        """Take a renewed credential of a peer's session; False when it is not proven, or ends no later."""
        name, credential = event.peer, event.credential
        peer = self._held(name)
        if peer is None or (peer.session, peer.incarnation) != (credential.session, credential.incarnation):
            return False
        keys = self._keys_of(name)
        renewed = dataclasses.replace(peer, credential=credential.encode())
        if renewed.credential == peer.credential or not self._introduced(renewed, now, at_home=event.at_home):
            return False
        if self._keys_of(name) == keys and self._ends_at(renewed) > self._ends_at(peer):
            return True
        # It has another session key, which our paths lack, or is the earlier one: a copy of an old introduction.
        self._hold(peer, keys)
        return False

    def _held(self, name: NodeName) -> Peer | None:
        """Return a peer by name, dormant or not."""
        dormant = self._dormant.get(name)
        return self._known.get(name) if dormant is None else dormant.peer

    def _keys_of(self, name: NodeName) -> PairKeys:
        dormant = self._dormant.get(name)
        return self._keys[name] if dormant is None else dormant.keys

    def _hold(self, peer: Peer, keys: PairKeys) -> None:
        """Replace what is known of a peer, which stays dormant if it is."""
        if peer.name in self._dormant:
            self._dormant.put(Dormant(peer, keys))
        else:
            self._known[peer.name], self._keys[peer.name] = peer, keys

    def _has_session(self, session: SessionId) -> bool:
        return any(peer.session == session for peer in self._known.values()) or self._dormant.has_session(session)

    def _introduced(self, peer: Peer, now: float, *, at_home: bool) -> bool:
        """Take a peer that proves itself; False when it does not, or when its credential is not verified now."""
        if not self._own.has_admitted(peer.credential) and not self._budget.take(peer.name, now, at_home=at_home):
            self._dropped["verifications_full"] += 1
            return False
        try:
            keys = self._own.admit(peer)
        except DecodeError:
            self._dropped["bad_credential"] += 1
            return False
        self._hold(peer, keys)
        return True

    def _ends_at(self, peer: Peer) -> float:
        """Return when its credential ends (seconds since 1970); minus infinity if it is bad."""
        with contextlib.suppress(DecodeError):
            self._own.admit(peer)
        return self._own.ends_at(peer.credential)

    def condemn(self, session: SessionId) -> None:
        """Refuse this session from now on, whatever its credential; see `recheck`."""
        self._own.condemn(session)

    def recheck(self) -> list[NodeName]:
        """Judge all peers again after a change of trust; return those dropped. See `OwnSession.forget_admitted`.

        Those that the view does not list are forgotten if they are bad now, or set aside if only their time is over.
        """
        for peer in self._dormant.aside():
            error = self._fault(peer)
            if error is not None and not _is_matter_of_time(error):
                self._dormant.take_aside(peer)
        for peer, _ in self._dormant.all():
            error = self._fault(peer)
            if error is not None:
                self._dropped["bad_credential"] += 1
                self._dormant.forget(peer.name)
                self._set_aside(peer, error)
        gone = []
        for name, peer in list(self._known.items()):
            error = self._fault(peer)
            if error is not None:
                self._dropped["bad_credential"] += 1
                if name in self._unlisted:
                    self._set_aside(peer, error)
                else:
                    self.refused[name] = RefusedPeer.of(peer, error)
                self._forget(name)
                gone.append(name)
        return gone

    def _fault(self, peer: Peer) -> DecodeError | None:
        """Judge a peer; return what is wrong with its credential."""
        try:
            self._own.admit(peer)
        except DecodeError as error:
            return error
        return None

    def _set_aside(self, peer: Peer, error: DecodeError) -> None:
        """Remember a peer that the view does not list, and would not bring back, if only its time is over."""
        if _is_matter_of_time(error):
            self._dormant.set_aside(peer)

    def all_refused(self) -> list[Peer]:
        """Return the refused peers, and those set aside: a corrected clock or new trust may prove them good."""
        return [*(refusal.peer for refusal in self.refused.values()), *self._dormant.aside()]

    def readmit(self, judged: Iterable[Peer]) -> list[NodeName]:
        """Take refused peers that have just been judged good (`OwnSession.admit`); return those taken.

        Those that were set aside are dormant then.
        """
        taken = []
        sessions = {peer.session for peer in self._known.values()}
        for peer in judged:
            if self._fault(peer) is None and self._dormant.take_aside(peer):
                self._dormant.put(Dormant(peer, self._own.admit(peer)))
                taken.append(peer.name)
                continue
            refusal = self.refused.get(peer.name)
            # Skip it if a newer view came meanwhile, or another peer has taken its session since.
            if refusal is None or refusal.peer is not peer or peer.session in sessions:
                continue
            if self._dormant.has_session(peer.session):
                continue
            if len(self._known) >= MAX_PEERS:
                break
            try:
                self._keys[peer.name] = self._own.admit(peer)
            except DecodeError:
                continue
            self._known[peer.name] = self._at_announced(peer, peer)
            sessions.add(peer.session)
            del self.refused[peer.name]
            taken.append(peer.name)
        self._dormant.make_room(len(self._known))
        return taken

    def _forget(self, name: NodeName) -> None:
        self._unlisted.discard(name)
        self._restarted_at.pop(name, None)
        del self._known[name], self._keys[name]

    def lay_down(self, name: NodeName) -> bool:
        """Make a peer whose last path died dormant if the view no longer lists it; return whether it is so now."""
        if name not in self._unlisted:
            return False
        self._unlisted.discard(name)
        self._dormant.put(Dormant(self._known.pop(name), self._keys.pop(name)))
        self._dormant.make_room(len(self._known))
        self._told.pop(name, None)
        return True

    def wake(self, name: NodeName) -> bool:
        """Make a dormant peer a peer again, since a path to it lives; return False if it is not dormant."""
        dormant = self._dormant.take(name)
        if dormant is None:
            return False
        self._known[name], self._keys[name] = dormant
        self._unlisted.add(name)
        self._told.pop(name, None)
        return True

    def may_call(self, name: NodeName, service: ServiceName) -> bool:
        """Cloud: return whether the control plane lets this robot call the service here; False if it is unknown.

        A dormant robot may still call what it was last let call: its request may come before its path is up.
        """
        peer = self._known.get(name) or self._held(name)
        return peer is not None and service in peer.may_call

    def session(self, name: NodeName) -> SessionId | None:
        """Return a peer's session."""
        peer = self._known.get(name)
        return None if peer is None else peer.session

    def held_session(self, name: NodeName) -> SessionId | None:
        """Return the session of a peer, dormant or not."""
        peer = self._held(name)
        return None if peer is None else peer.session

    def take_forgotten(self) -> dict[NodeName, SessionId]:
        """Return the dormant peers forgotten since the last call, and their sessions."""
        return self._dormant.take_forgotten()

    def for_links(self) -> tuple[LinkPeer, ...]:
        """Return the peers as links need them, the dormant ones included: links answer them."""
        told = {}
        awake = ((peer, self._keys[name], False) for name, peer in self._known.items())
        for peer, keys, dormant in (*((*kept, True) for kept in self._dormant.all()), *awake):
            before = self._told.get(peer.name)
            if before is None or before[0] is not peer or before[1] is not keys or before[2].dormant is not dormant:
                before = peer, keys, _link_peer(peer, keys, self._announced.eras[peer.name], dormant=dormant)
            told[peer.name] = before
        self._told = told
        return tuple(link_peer for _, _, link_peer in told.values())


def _is_matter_of_time(error: DecodeError) -> bool:
    return isinstance(error, CertificateError) and error.reason in MATTERS_OF_TIME


def _link_peer(peer: Peer, keys: PairKeys, era: int, *, dormant: bool) -> LinkPeer:
    by_interface: dict[InterfaceId, list[Address]] = {}
    # A dormant robot has to come by itself, as it does after each outage. A NAT may let nobody else begin.
    for candidate in () if dormant and peer.role is Role.ROBOT else peer.candidates:
        addresses = by_interface.setdefault(candidate.interface_id, [])
        if candidate.address not in addresses:
            addresses.append(candidate.address)
    return LinkPeer(
        peer.name,
        peer.session,
        peer.token,
        peer.incarnation,
        peer.credential,
        keys,
        tuple((interface, tuple(addresses)) for interface, addresses in sorted(by_interface.items())),
        era,
        dormant,
    )
