"""Describes the members of the mesh: registrations, peers, services, addresses, revocation lists.

Frozen values, without IO and without protobuf. Times are seconds (float), probabilities in [0, 1], unless a name says
otherwise.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from plr.protos.model.ids import (
    NO_VERSION,
    Address,
    InterfaceId,
    InterfaceName,
    NodeName,
    Role,
    ServiceName,
    SessionId,
    Version,
)
from plr.protos.model.redundancy_mode import DEFAULT_HEDGE_QUANTILE, RedundancyMode

if TYPE_CHECKING:
    from collections.abc import Sequence

DEFAULT_COST_PER_REQUEST = 1.0
"""Default cost of a request over an interface, so that a service in mode cheapest sends few copies where their cost is
unknown."""


@dataclass(frozen=True, slots=True)
class InterfaceLabel:
    """What a robot says about one of its interfaces, for the choice of paths."""

    interface: InterfaceName
    carrier: str = ""
    """Carrier whose network it uses; interfaces with the same carrier fail together. Empty if unknown."""
    cost_per_request: float = DEFAULT_COST_PER_REQUEST
    """Cost of a request over it, in any one currency."""


class Copies(NamedTuple):
    """How many copies of a request are sent, each over another interface; 0: as many as there are interfaces."""

    least: int = 0
    most: int = 0

    def over(self, interfaces: int) -> Copies:
        """Return the numbers for so many interfaces."""
        return Copies(*(min(count or interfaces, interfaces) for count in self))


EVERY_INTERFACE = Copies()
AT_MOST_EVERY_INTERFACE = Copies(least=1)


TOKEN_BYTES = 16
"""Size of a sidecar's stable secret, and of the token that each peer gets instead (`protos/trust/pair_token.py`)."""


POLICY_PENDING = 0
"""In place of a policy's fingerprint: it must not be applied yet, as peers may still be coming back."""


NO_POLICY = 1
"""In place of a policy's fingerprint: everything is allowed."""


MAX_CREDENTIAL_BYTES = 2048
"""Longest encoded session credential: a certificate of some 600 bytes and the rest of what is signed."""


MAX_SIGNATURE_BYTES = 72
"""Longest signature: ECDSA on P-256 in DER."""


MAX_CANDIDATES_OF_INTERFACE = 8
"""Addresses at which peers look for one interface: IPv4, some IPv6, the NAT mapping of each, one advertised."""


MAX_SIDECARS = 4096
"""Sidecars that a control plane knows at once. A further one is refused, not let in for another."""


MAX_PEERS = MAX_SIDECARS
"""Peers of one sidecar."""


MAX_UNMET = 64
"""Reported services that a configuration names but nobody serves."""


class CandidateKind(enum.Enum):
    """How an address was learnt."""

    HOST = "host"
    SERVER_REFLEXIVE = "srflx"


class RemovalReason(enum.Enum):
    """Why a peer left the view."""

    LEASE_EXPIRED = "lease_expired"
    LEFT = "left"
    REVOKED = "revoked"
    FORBIDDEN = "forbidden"
    """It is there, but the access policy allows the two no contact."""
    EXPIRED = "expired"
    """Its certificate has expired."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """An address at which an interface of a sidecar may be reached."""

    interface_id: InterfaceId
    interface: InterfaceName
    kind: CandidateKind
    address: Address


@dataclass(frozen=True, slots=True)
class ServiceOffer:
    """A service that a cloud sidecar can run; `capacity` 0 means no limit."""

    name: ServiceName
    type: str
    capacity: int = 0
    cost_per_request: float = 0.0
    """Cost of a request run there, in the currency of the interfaces' costs."""


@dataclass(frozen=True, slots=True)
class ServiceUse:
    """A service that a robot sidecar carries now."""

    name: ServiceName
    type: str
    deadline_s: float
    idempotent: bool
    copies: Copies = EVERY_INTERFACE
    target_miss: float = 0.0
    """Above 0: the cheapest mapping that misses the deadline no more often; 0: the most reliable one."""
    fallback_up: bool | None = None
    """Whether its fallback on the robot itself can be called; None: it has none."""
    redundancy: RedundancyMode = RedundancyMode.REPLICATE
    """Which of the mapped pairs carry a copy, and when; used for the prediction."""
    hedge_quantile: float = DEFAULT_HEDGE_QUANTILE
    """With RedundancyMode.HEDGE: the share of first copies to wait for."""
    budgeted: bool = False
    """Whether budgets may hold back all copies but the first."""
    wanted_miss: float = 0.0
    """Share of misses that the configuration allows, even if it does not decide the mapping; 0: none named."""


@dataclass(frozen=True, slots=True)
class CallPermit:
    """The services that a robot may call on the cloud that receives this; test one with `in`."""

    services: frozenset[ServiceName] = frozenset()
    everything: bool = False
    """Whether no policy is in force."""

    def __contains__(self, service: object) -> bool:
        return self.everything or service in self.services

    def __bool__(self) -> bool:
        return self.everything or bool(self.services)


NO_CALLS = CallPermit()


ALL_CALLS = CallPermit(everything=True)


@dataclass(frozen=True, slots=True)
class Peer:
    """A sidecar as its peers see it."""

    name: NodeName
    role: Role
    session: SessionId
    token: bytes = field(repr=False)
    """Token that introduces it to the holder of this; inside the control plane, its own secret, told to nobody."""
    incarnation: int
    candidates: tuple[Candidate, ...] = ()
    offers: tuple[ServiceOffer, ...] = ()
    draining: bool = False
    credential: bytes = field(default=b"", repr=False)
    may_call: CallPermit = NO_CALLS
    """What a robot may call, sent to clouds; nothing by default."""
    candidates_serial: int = 0
    candidates_signature: bytes = field(default=b"", repr=False)
    """As in `CandidateSet`."""

    def with_token(self, token: bytes) -> Peer:
        """Return a copy with another token, three times as fast as `replace`: control planes do this 100,000 times."""
        return Peer(
            self.name,
            self.role,
            self.session,
            token,
            self.incarnation,
            self.candidates,
            self.offers,
            self.draining,
            self.credential,
            self.may_call,
            self.candidates_serial,
            self.candidates_signature,
        )


@dataclass(frozen=True, slots=True)
class RemovedPeer:
    """A peer that left since the version the sidecar held."""

    name: NodeName
    reason: RemovalReason


@dataclass(frozen=True, slots=True)
class PeerSet:
    """The peers of one sidecar at one version: all of them, or what changed since another version."""

    version: Version
    nonce: int
    peers: Sequence[Peer] = ()
    removed: tuple[RemovedPeer, ...] = ()
    policy: int = POLICY_PENDING
    """Fingerprint of the access policy that this set follows, or POLICY_PENDING, or NO_POLICY."""
    base: Version = NO_VERSION
    """Above 0: `peers` are new or changed since this version, and `removed` left since then."""
    more: bool = False
    """Whether the next message continues this set."""


@dataclass(frozen=True, slots=True)
class Registration:
    """The first message of a sidecar on its stream, about itself."""

    protocol_version: int
    """The oldest version that it speaks."""
    name: NodeName
    role: Role
    session: SessionId
    token: bytes = field(repr=False)
    """Its own secret, for the control plane only."""
    incarnation: int
    software_version: str
    peers_version: Version = NO_VERSION
    mapping_version: Version = NO_VERSION
    credential: bytes = field(default=b"", repr=False)
    region: str = ""
    """Region of a cloud; clouds in the same region fail together. Empty if unknown."""
    incremental: bool = False
    """Whether it accepts changes of its peers, and sets in several messages."""
    newest_protocol_version: int = 0
    """The newest version that it speaks; 0 if it speaks only one."""


@dataclass(frozen=True, slots=True)
class CandidateSet:
    """All candidates of a sidecar and what it says about their interfaces, replacing those it sent before."""

    candidates: tuple[Candidate, ...] = ()
    labels: tuple[InterfaceLabel, ...] = ()
    serial: int = 0
    """Grows within a session (64 bits)."""
    signature: bytes = field(default=b"", repr=False)
    """Signature over candidates, serial and session, for the peers (`candidate_signature`); none in insecure mode."""
    down: tuple[InterfaceLabel, ...] = ()
    """Interfaces that it would use but that carry nothing now; for the operator only."""


@dataclass(frozen=True, slots=True)
class HeldList:
    """A revocation list in use; `ca` is the first 64 bits of the SHA-256 of the CA's certificate."""

    ca: int
    number: int
    signed_at_s: int
    """Seconds since 1970."""


@dataclass(frozen=True, slots=True)
class RevocationSet:
    """The newest list of each CA that has one."""

    lists: tuple[HeldList, ...] = ()
    too_old: int = 0
    """Number of CAs whose list is too old, so that their nodes are not talked to."""


NO_REVOCATIONS = RevocationSet()
"""No list, or none reported."""


@dataclass(frozen=True, slots=True)
class ServiceSet:
    """All services a sidecar offers and carries, replacing those it sent before."""

    offers: tuple[ServiceOffer, ...] = ()
    uses: tuple[ServiceUse, ...] = ()
    unmet: tuple[ServiceName, ...] = ()
    """Services that its configuration names but nobody is known to serve, at most MAX_UNMET; for the operator."""
    untyped: tuple[ServiceName, ...] = ()
    """Services not carried or offered, as their type is not installed there, at most MAX_UNMET; for the operator."""
    unreached: tuple[ServiceName, ...] = ()
    """Robot: services that its configuration names and known servers offer, none of which it reaches, at most
    MAX_UNMET; for the operator."""
