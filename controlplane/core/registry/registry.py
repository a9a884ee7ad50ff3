"""Keeps who is present: registrations with leases, without IO.

A sidecar is known by its name from its registration until its lease ends or it says goodbye. Losing the stream alone
does not remove it: a robot in a tunnel is still there.
"""

from __future__ import annotations

import enum
import heapq
from collections import OrderedDict
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple, NewType

from plr.controlplane.core.overload.postponed import Postponed
from plr.controlplane.core.overload.registration_share import RegistrationShare
from plr.protos.model.ids import NodeName, Role
from plr.protos.model.members import (
    MAX_SIDECARS,
    NO_REVOCATIONS,
    CandidateSet,
    Peer,
    Registration,
    RemovalReason,
    RevocationSet,
)

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from plr.protos.model.ids import ServiceName, SessionId
    from plr.protos.model.members import Candidate, InterfaceLabel, ServiceOffer, ServiceSet, ServiceUse

StreamId = NewType("StreamId", int)
"""Number of one stream, unique in one run of the control plane."""

MAX_REMEMBERED_OFFERS = 1024
"""Service names remembered for one cloud, as many as it may offer at once. Beyond that, only its present offers."""

MAX_REMEMBERED_REMOVALS = 4096
"""Reasons of removals kept for notices, and session numbers kept for members whose lease ended; beyond that the oldest
is evicted, and its notice says "lease expired"."""


_PEER_BYTES, _CANDIDATE_BYTES, _OFFER_BYTES = 80, 24, 16
"""Size of a peer, an address and an offer in a message, besides their names."""

POSTPONE_S = 1.0
"""Time from one judgement of a lease to the next, for a member whose bytes have arrived but are not read yet: a
second's messages of a fleet are read meanwhile."""

MAX_POSTPONED = 4
"""Judgements postponed for one silence: bytes are not words. A member that says nothing while its kernel or gRPC still
answers loses its lease this many seconds later."""


class Refusal(enum.Enum):
    """Why a registration is not accepted."""

    OLDER_INCARNATION = "a newer incarnation of this name is registered"
    NAME_TAKEN = (
        "another sidecar holds this name, and its lease has not ended: issue a certificate of its own to each node "
        "(plr ca issue); a node that was set up again gets in when the lease has ended"
    )
    SESSION_TAKEN = "another sidecar has this session number, or had it when its lease ended: draw a new one"
    FULL = f"{MAX_SIDECARS} sidecars are registered, which is the limit"
    TOO_OFTEN = "it registers too often: check why it keeps restarting or losing its connection"
    NAME_MISMATCH = "the certificate has another name: set name to the certificate's, or leave it out"
    WRONG_ROLE = "the certificate has another role: set role to the certificate's, or leave it out"
    BAD_CREDENTIAL = "the credential is of another run, or is not signed with this certificate"
    VERSION = "it speaks no version of the protocol that this control plane speaks"
    MALFORMED = "its first message is no registration, or one that has no meaning here"


@dataclass(frozen=True, slots=True)
class AcceptedRegistration:
    """An accepted registration; `replaced` is the stream that has to end for it."""

    replaced: StreamId | None
    new_run: bool
    """Whether the sidecar is new, or was restarted; not merely connected again."""


@dataclass(frozen=True, slots=True)
class Sidecar:
    """One registered sidecar; replaced as a whole when anything about it changes."""

    registration: Registration
    stream: StreamId | None
    candidates: tuple[Candidate, ...] | None = None
    """None until announced."""
    services: ServiceSet | None = None
    """None until announced."""
    draining: bool = False
    offered: frozenset[ServiceName] = frozenset()
    """Services it has offered since it registered, at most MAX_REMEMBERED_OFFERS."""
    carried: frozenset[ServiceName] = frozenset()
    """Services it has carried in this run since it registered, at most MAX_REMEMBERED_OFFERS."""
    labels: tuple[InterfaceLabel, ...] = ()
    """What a robot says of its interfaces."""
    down: tuple[InterfaceLabel, ...] = ()
    """Interfaces that it would use and that carry nothing now."""
    candidates_serial: int = 0
    candidates_signature: bytes = field(default=b"", repr=False)
    signed_under: bytes = field(default=b"", repr=False)
    """The credential in whose session, and with whose certificate, the candidates were signed."""
    revocations: RevocationSet = NO_REVOCATIONS
    """Which revocation lists it uses."""

    @property
    def name(self) -> NodeName:
        """Its name."""
        return self.registration.name

    @property
    def role(self) -> Role:
        """What it is for."""
        return self.registration.role

    @property
    def ready(self) -> bool:
        """Whether it announced its addresses and services; before that, its peers would learn nothing useful."""
        return self.candidates is not None and self.services is not None

    @property
    def offers(self) -> tuple[ServiceOffer, ...]:
        """Services it can run."""
        return self.services.offers if self.services is not None else ()

    @property
    def uses(self) -> tuple[ServiceUse, ...]:
        """Services it carries."""
        return self.services.uses if self.services is not None else ()

    @property
    def unmet(self) -> tuple[ServiceName, ...]:
        """Services that its configuration names and nobody serves."""
        return self.services.unmet if self.services is not None else ()

    @property
    def unreached(self) -> tuple[ServiceName, ...]:
        """Services that its configuration names and known servers offer, none of which it reaches."""
        return self.services.unreached if self.services is not None else ()

    @property
    def untyped(self) -> tuple[ServiceName, ...]:
        """Services that it would carry or offer if their type were installed there."""
        return self.services.untyped if self.services is not None else ()

    @property
    def withdrawn(self) -> frozenset[ServiceName]:
        """Services that it offered since it registered, but not now."""
        return self.offered.difference(offer.name for offer in self.offers)

    def having_said(self, told: CandidateSet | ServiceSet) -> Sidecar:
        """Return the same with other addresses and statements about its interfaces, or with other services."""
        if isinstance(told, CandidateSet):
            return replace(
                self,
                candidates=told.candidates,
                labels=told.labels,
                down=told.down,
                candidates_serial=told.serial,
                candidates_signature=told.signature,
                signed_under=self.registration.credential if told.signature else b"",
            )
        now_offered = frozenset(offer.name for offer in told.offers)
        offered = self.offered | now_offered
        now_carried = frozenset(use.name for use in told.uses)
        carried = self.carried | now_carried
        return replace(
            self,
            services=told,
            offered=offered if len(offered) <= MAX_REMEMBERED_OFFERS else now_offered,
            carried=carried if len(carried) <= MAX_REMEMBERED_OFFERS else now_carried,
        )

    @property
    def told_bytes(self) -> int:
        """Rough size of what its peers are told whenever any of that changes."""
        if not self.ready:
            return 0
        size = _PEER_BYTES + len(self.registration.credential) + len(self.candidates_signature)
        size += sum(_CANDIDATE_BYTES + len(one.interface) for one in self.candidates or ())
        return size + sum(_OFFER_BYTES + len(offer.name) + len(offer.type) for offer in self.offers)

    def as_peer(self) -> Peer:
        """Return what its peers are sent about it, with its own token; each gets the one made for it (`ToldPeers`)."""
        # A signature of the previous run or certificate is invalid under this credential: the sidecar announces again
        # in a moment, and until then each peer continues with what it has.
        stale = bool(self.candidates_signature) and self.signed_under != self.registration.credential
        return Peer(
            name=self.registration.name,
            role=self.registration.role,
            session=self.registration.session,
            token=self.registration.token,
            incarnation=self.registration.incarnation,
            candidates=() if stale else self.candidates or (),
            offers=self.offers,
            draining=self.draining,
            credential=self.registration.credential,
            candidates_serial=self.candidates_serial,
            candidates_signature=b"" if stale else self.candidates_signature,
        )


DEPARTURES = (RemovalReason.LEASE_EXPIRED, RemovalReason.LEFT, RemovalReason.REVOKED, RemovalReason.EXPIRED)
"""Why a sidecar leaves the registry, and so every view."""


@dataclass(slots=True)
class RegistryCounters:
    """Counts what happened, for the metrics."""

    refused: dict[Refusal, int] = field(default_factory=lambda: dict.fromkeys(Refusal, 0))
    departed: dict[RemovalReason, int] = field(default_factory=lambda: dict.fromkeys(DEPARTURES, 0))
    removals_forgotten: int = 0


@dataclass(slots=True)
class _Lease:
    """Kept apart from the sidecar, which is replaced when it changes: this changes with each message."""

    length_s: float
    end: float
    heard_at: float
    postponed: int = 0
    """Times postponed since it was last heard."""


class _Removal(NamedTuple):
    """The end of a sidecar's registration."""

    reason: RemovalReason
    heard_at: float
    """When it was last heard."""
    session: SessionId


class Registry:
    """All registered sidecars. Times are monotonic seconds."""

    def __init__(self, *, lease_s: float) -> None:
        self.lease_s = lease_s
        """Lease of sidecars that register, or are told again, from now on."""
        self._leases: dict[NodeName, _Lease] = {}
        self._sidecars: dict[NodeName, Sidecar] = {}
        self._sessions: dict[SessionId, NodeName] = {}
        """Whose each session number is. One whose lease ended keeps its number, as its peers keep it. With certificates
        the number follows from the key; without, another that saw it could cut it off by registering with it."""
        self._shares = RegistrationShare()
        self._offering: dict[ServiceName, set[NodeName]] = {}
        """The clouds that offer each service."""
        self._removals: OrderedDict[NodeName, _Removal] = OrderedDict()
        # One entry per name, at the end of its lease at the latest: renewing a lease does not touch it.
        self._ends: list[tuple[float, NodeName]] = []
        self._awaited: set[NodeName] = set()
        self.postponed = Postponed()
        self.counters = RegistryCounters()

    def __iter__(self) -> Iterator[Sidecar]:
        return iter(self._sidecars.values())

    def __len__(self) -> int:
        return len(self._sidecars)

    def get(self, name: NodeName) -> Sidecar | None:
        """Return the sidecar of that name."""
        return self._sidecars.get(name)

    def register(self, registration: Registration, stream: StreamId, now: float) -> AcceptedRegistration | Refusal:
        """Let a sidecar in, or say why not.

        A name belongs to the token that took it first for as long as its lease lasts, and within a token to the newest
        incarnation; the same run that connects again replaces its own older stream.
        """
        name = registration.name
        if self._sessions.get(registration.session, name) != name:
            return self._refuse(Refusal.SESSION_TAKEN)
        known = self._sidecars.get(name)
        if known is None:
            if len(self._sidecars) >= MAX_SIDECARS:
                return self._refuse(Refusal.FULL)
            if not self._shares.take(name, now, new_run=True):
                return self._refuse(Refusal.TOO_OFTEN)
            self._forget_removal(name)
            self._sidecars[name] = Sidecar(registration, stream)
            self._leases[name] = _Lease(self.lease_s, now + self.lease_s, now)
            self._sessions[registration.session] = name
            self._await_end(name)
            return AcceptedRegistration(replaced=None, new_run=True)
        before = known.registration
        if registration.token != before.token:
            return self._refuse(Refusal.NAME_TAKEN)
        if registration.incarnation < before.incarnation:
            return self._refuse(Refusal.OLDER_INCARNATION)
        same_run = registration.session == before.session
        if registration.incarnation == before.incarnation and not same_run:
            return self._refuse(Refusal.NAME_TAKEN)
        if not self._shares.take(name, now, new_run=_tells_anything(registration, before)):
            return self._refuse(Refusal.TOO_OFTEN)
        # What it last announced holds until it announces again, a moment from now: its peers see no gap.
        carried = known.carried if same_run else frozenset()
        self._sidecars[name] = replace(known, registration=registration, stream=stream, draining=False, carried=carried)
        del self._sessions[before.session]
        self._sessions[registration.session] = name
        self._leases[name] = _Lease(self.lease_s, now + self.lease_s, now)
        return AcceptedRegistration(replaced=known.stream, new_run=not same_run)

    def remove(self, name: NodeName, reason: RemovalReason) -> Sidecar | None:
        """Remove it, whatever its lease; return it as it was, or None if it was not there."""
        known = self._sidecars.get(name)
        if known is not None:
            self._remove(name, reason)
        return known

    def _refuse(self, refusal: Refusal) -> Refusal:
        self.counters.refused[refusal] += 1
        return refusal

    def lease_end(self, name: NodeName) -> float:
        """Return when a registered sidecar's lease ends unless it speaks."""
        return self._leases[name].end

    def told_lease_s(self, name: NodeName) -> float:
        """Return how long a registered sidecar was told that it may be silent."""
        return self._leases[name].length_s

    def tell_lease(self, name: NodeName) -> None:
        """Note that a registered sidecar is told the present lease. Its own one goes on, as it may learn of that
        late."""
        self._leases[name].length_s = self.lease_s

    def touch(self, name: NodeName, stream: StreamId, now: float) -> bool:
        """Renew the lease because `stream` spoke; return False if it is no longer the sidecar's stream."""
        if not self._is_current(name, stream):
            return False
        lease = self._leases[name]
        lease.end = max(lease.end, now + lease.length_s)
        lease.heard_at = now
        lease.postponed = 0
        return True

    def _is_current(self, name: NodeName, stream: StreamId) -> bool:
        known = self._sidecars.get(name)
        return known is not None and known.stream == stream

    def set_candidates(self, name: NodeName, told: CandidateSet) -> bool:
        """Replace its addresses and what it says of its interfaces; return True if they changed for others: which ones
        carry nothing is the operator's business."""
        known = self._sidecars[name]
        changed = self._sidecars[name] = known.having_said(told)
        return changed != replace(known, down=told.down)

    def set_services(self, name: NodeName, services: ServiceSet) -> bool:
        """Replace its services; return True if they changed for others: unmet ones are the operator's business."""
        known = self._sidecars[name]
        before = known.services
        self._offers_no_more(known)
        self._sidecars[name] = known.having_said(services)
        if known.role is Role.CLOUD:
            for offer in services.offers:
                self._offering.setdefault(offer.name, set()).add(name)
        return before is None or (services.offers, services.uses) != (before.offers, before.uses)

    def unsay(self, name: NodeName) -> None:
        """Withdraw what it has announced of its addresses and services, until it announces again."""
        known = self._sidecars[name]
        self._offers_no_more(known)
        self._sidecars[name] = replace(known, candidates=None, services=None)

    def _offers_no_more(self, sidecar: Sidecar) -> None:
        for offer in sidecar.offers:
            clouds = self._offering.get(offer.name)
            if clouds is not None:
                clouds.discard(sidecar.name)
                if not clouds:
                    del self._offering[offer.name]

    @property
    def shares_forgotten(self) -> int:
        """Members whose shares of what the registry counts were reset for lack of room."""
        return self._shares.shares.forgotten + self.postponed.shares.forgotten

    def offering(self, service: ServiceName) -> Iterator[Sidecar]:
        """Return the registered clouds that offer it, whether or not they may."""
        return (self._sidecars[name] for name in self._offering.get(service, ()))

    def set_revocations(self, name: NodeName, held: RevocationSet) -> None:
        """Note which revocation lists it uses."""
        self._sidecars[name] = replace(self._sidecars[name], revocations=held)

    def set_draining(self, name: NodeName) -> bool:
        """Note that it is about to leave; return True if that is news."""
        known = self._sidecars[name]
        self._sidecars[name] = replace(known, draining=True)
        return not known.draining

    def disconnect(self, name: NodeName, stream: StreamId) -> RemovalReason | None:
        """Note that its stream ended: a draining sidecar has left, others stay until their lease ends.

        Return the reason if it was removed.
        """
        if not self._is_current(name, stream):
            return None
        known = self._sidecars[name]
        if known.draining:
            self._remove(name, RemovalReason.LEFT)
            return RemovalReason.LEFT
        self._sidecars[name] = replace(known, stream=None)
        return None

    def _await_end(self, name: NodeName) -> None:
        if name not in self._awaited:
            self._awaited.add(name)
            heapq.heappush(self._ends, (self._leases[name].end, name))

    def next_expiry(self) -> float | None:
        """Return when to call `expire` next; it may then find that the lease was renewed."""
        return self._ends[0][0] if self._ends else None

    def due(self, now: float) -> list[NodeName]:
        """Return those whose lease ended, whom `expire` would remove now unless something of theirs is left to read."""
        found = self._take_due(now)
        for name in found:
            self._await_end(name)
        return found

    def _take_due(self, now: float) -> list[NodeName]:
        found: list[NodeName] = []
        while self._ends and self._ends[0][0] <= now:
            _, name = heapq.heappop(self._ends)
            self._awaited.discard(name)
            lease = self._leases.get(name)
            if lease is None:
                continue
            if lease.end > now:
                self._await_end(name)
            else:
                found.append(name)
        return found

    def expire(self, now: float, unread: Collection[NodeName] = ()) -> list[Sidecar]:
        """Remove those whose lease ended, and return them as they were.

        For those in `unread`, bytes have arrived after what was last read. They are judged a little later, some times.
        """
        gone: list[Sidecar] = []
        for name in self._take_due(now):
            lease = self._leases[name]
            if name in unread and lease.postponed < MAX_POSTPONED:
                lease.postponed += 1
                lease.end = now + POSTPONE_S
                self.postponed.note(name, now)
                self._await_end(name)
                continue
            gone.append(self._sidecars[name])
            self._remove(name, RemovalReason.LEASE_EXPIRED)
        return gone

    def _remove(self, name: NodeName, reason: RemovalReason) -> None:
        sidecar = self._sidecars.pop(name)
        session = sidecar.registration.session
        if reason is not RemovalReason.LEASE_EXPIRED:
            del self._sessions[session]
        self._offers_no_more(sidecar)
        heard_at = self._leases.pop(name).heard_at
        self.counters.departed[reason] += 1
        self._removals[name] = _Removal(reason, heard_at, session)
        if len(self._removals) > MAX_REMEMBERED_REMOVALS:
            self._forget_removal(next(iter(self._removals)))
            self.counters.removals_forgotten += 1

    def _forget_removal(self, name: NodeName) -> None:
        removal = self._removals.pop(name, None)
        if removal is not None and self._sessions.get(removal.session) == name:
            del self._sessions[removal.session]

    def removal_reason(self, name: NodeName) -> RemovalReason:
        """Return why that sidecar is gone; the careful guess for one never known or forgotten is "lease expired"."""
        removed = self._removals.get(name)
        return RemovalReason.LEASE_EXPIRED if removed is None else removed.reason

    def heard_at(self, name: NodeName, now: float) -> float:
        """Return when a sidecar, registered or gone, last said something; `now` for one never known or forgotten."""
        lease = self._leases.get(name)
        if lease is not None:
            return lease.heard_at
        removed = self._removals.get(name)
        return now if removed is None else removed.heard_at


def _tells_anything(registration: Registration, before: Registration) -> bool:
    """Return whether a registration changes anything for others: what it holds itself does not."""
    held = replace(before, peers_version=registration.peers_version, mapping_version=registration.mapping_version)
    return registration != held
