"""What is said of the members of the mesh: registrations, peers, services, addresses, revocation lists.

Frozen values, without IO and without protobuf. Times are seconds (float), probabilities in [0, 1], unless a name says
otherwise.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from protos.model.ids import (
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
from protos.model.redundancy_mode import DEFAULT_HEDGE_QUANTILE, RedundancyMode

if TYPE_CHECKING:
    from collections.abc import Sequence

DEFAULT_CHARGE = 1.0
"""What a request over an interface costs unless said otherwise: so that a service that is to be cheap sends few copies
where nobody told what they cost."""


@dataclass(frozen=True, slots=True)
class InterfaceLabel:
    """What a robot says of one of its interfaces, for the choice of paths."""

    interface: InterfaceName
    carrier: str = ""
    """Whose network it uses; interfaces with the same one fail together. Empty: not known."""
    charge: float = DEFAULT_CHARGE
    """What a request over it costs, in any one currency."""


class Copies(NamedTuple):
    """How many copies of a request are sent, each over another interface; 0: as many as there are interfaces."""

    least: int = 0
    most: int = 0

    def over(self, interfaces: int) -> Copies:
        """The numbers for so many interfaces."""
        return Copies(*(min(count or interfaces, interfaces) for count in self))


EVERY_INTERFACE = Copies()
AT_MOST_EVERY_INTERFACE = Copies(least=1)


TOKEN_BYTES = 16
"""Size of the stable secret of a sidecar, and of what each peer is told of it (`protos/trust/pair_token.py`)."""


POLICY_PENDING = 0
"""In place of a policy's fingerprint: nothing is to be judged by it yet, as peers may still be coming back."""


NO_POLICY = 1
"""In place of a policy's fingerprint: everything is allowed."""


MAX_CREDENTIAL_BYTES = 2048
"""Longest encoded session credential: a certificate of some 600 bytes and what is signed beside it."""


MAX_SIGNATURE_BYTES = 72
"""Longest signature: ECDSA on P-256 in DER."""


MAX_CANDIDATES_OF_INTERFACE = 8
"""Addresses under which peers look for one interface: IPv4, some of IPv6, what a NAT makes of each, one advertised."""


MAX_PEERS = 4096
"""Peers of one sidecar: as many sidecars as a control plane registers."""


MAX_UNMET = 64
"""Services told of that a configuration names and nobody serves."""


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
    """It is there, but the access policy leaves the two nothing to do with each other."""
    EXPIRED = "expired"
    """Its certificate has ended."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """One address under which one interface of a sidecar may be reached."""

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
    charge: float = 0.0
    """What a request costs that it runs, in the currency of the interfaces' charges."""


@dataclass(frozen=True, slots=True)
class ServiceUse:
    """A service that a robot sidecar carries right now."""

    name: ServiceName
    type: str
    deadline_s: float
    idempotent: bool
    copies: Copies = EVERY_INTERFACE
    target_miss: float = 0.0
    """Above 0: the cheapest mapping that misses the deadline no more often; 0: the most reliable one."""
    fallback_up: bool | None = None
    """Whether its fallback on the robot itself can be asked; None: it has none."""
    redundancy: RedundancyMode = RedundancyMode.REPLICATE
    """Which of the mapped pairs carry a copy, and when: for the prediction."""
    hedge_quantile: float = DEFAULT_HEDGE_QUANTILE
    """With RedundancyMode.HEDGE: the share of first copies that is waited for."""
    budgeted: bool = False
    """Budgets may keep back all copies but the first one."""
    wanted_miss: float = 0.0
    """The share of misses that the configuration allows, also where no mapping is chosen by it; 0: it names none."""


@dataclass(frozen=True, slots=True)
class CallPermit:
    """Which services a robot may call on the cloud that is told of it; `in` asks for one."""

    services: frozenset[ServiceName] = frozenset()
    everything: bool = False
    """No policy is in force."""

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
    """What it introduces itself with to whoever holds this; inside the control plane its own, which nobody is told."""
    incarnation: int
    candidates: tuple[Candidate, ...] = ()
    offers: tuple[ServiceOffer, ...] = ()
    draining: bool = False
    credential: bytes = field(default=b"", repr=False)
    may_call: CallPermit = NO_CALLS
    """Of a robot, told to clouds; nothing unless said otherwise."""
    candidates_serial: int = 0
    candidates_signature: bytes = field(default=b"", repr=False)
    """As in `CandidateSet`."""

    def with_token(self, token: bytes) -> Peer:
        """Return it with another token, three times as fast as `replace`: a control plane does it 100,000 times."""
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
    """Above 0: `peers` are those that are new or different since this version, and `removed` left since then."""
    more: bool = False
    """The next message goes on with this set."""


@dataclass(frozen=True, slots=True)
class Registration:
    """What a sidecar says of itself first on its stream."""

    protocol_version: int
    """The oldest that it speaks."""
    name: NodeName
    role: Role
    session: SessionId
    token: bytes = field(repr=False)
    """Its own, for the control plane alone."""
    incarnation: int
    software_version: str
    peers_version: Version = NO_VERSION
    mapping_version: Version = NO_VERSION
    credential: bytes = field(default=b"", repr=False)
    region: str = ""
    """Of a cloud: where it stands; clouds with the same one fail together. Empty: not known."""
    incremental: bool = False
    """It takes changes of its peers, and sets in several messages."""
    newest_protocol_version: int = 0
    """0: it speaks one alone."""


@dataclass(frozen=True, slots=True)
class CandidateSet:
    """All candidates of a sidecar, with what it says of their interfaces, replacing those it sent before."""

    candidates: tuple[Candidate, ...] = ()
    labels: tuple[InterfaceLabel, ...] = ()
    serial: int = 0
    """Grows within a session (64 bits)."""
    signature: bytes = field(default=b"", repr=False)
    """Over candidates, serial and session, for the peers (`candidate_signature`); none in insecure mode."""
    down: tuple[InterfaceLabel, ...] = ()
    """Interfaces that it would use and that carry nothing now; for the operator's eyes."""


@dataclass(frozen=True, slots=True)
class HeldList:
    """A revocation list that somebody uses; `ca` is the first 64 bits of the SHA-256 of the CA's certificate."""

    ca: int
    number: int
    signed_at_s: int
    """Seconds since 1970."""


@dataclass(frozen=True, slots=True)
class RevocationSet:
    """The newest list of each CA that has one."""

    lists: tuple[HeldList, ...] = ()
    too_old: int = 0
    """CAs whose list is older than may be, so that their nodes are not talked to."""


NO_REVOCATIONS = RevocationSet()
"""No list, or none told of."""


@dataclass(frozen=True, slots=True)
class ServiceSet:
    """All services a sidecar offers and carries, replacing those it sent before."""

    offers: tuple[ServiceOffer, ...] = ()
    uses: tuple[ServiceUse, ...] = ()
    unmet: tuple[ServiceName, ...] = ()
    """That its configuration names and nobody serves, as far as it knows, at most MAX_UNMET; for the operator."""
    untyped: tuple[ServiceName, ...] = ()
    """That it cannot carry or offer, as their type is not installed there, at most MAX_UNMET; for the operator."""
    unreached: tuple[ServiceName, ...] = ()
    """Robot: that its configuration names and servers offer that it knows of, none of which it reaches, at most
    MAX_UNMET; for the operator."""
