"""The words both planes speak: frozen values and typed identifiers, without IO and without protobuf.

Times are seconds (float) and probabilities are in [0, 1] unless a name says otherwise.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NewType

from protos.preferences import EVERY_INTERFACE, Copies
from protos.redundancy_mode import DEFAULT_HEDGE_QUANTILE, RedundancyMode

if TYPE_CHECKING:
    from collections.abc import Sequence

    from protos.base.histogram import Histogram
    from protos.preferences import InterfaceLabel

PROTOCOL_VERSION = 3
"""The newest that is spoken here."""

OLDEST_PROTOCOL_VERSION = 3
"""The oldest: the one before the newest. Nothing that spoke 2 was ever let out."""

"""Version of the control stream and of the datagram layout; peers of another version are refused."""

NodeName = NewType("NodeName", str)
"""Name of a sidecar, unique in the mesh."""

InterfaceName = NewType("InterfaceName", str)
"""Name of a network interface of one sidecar, such as wlan0."""

InterfaceId = NewType("InterfaceId", int)
"""Number of an interface, 0 to 255, stable within one session."""

ServiceName = NewType("ServiceName", str)
"""Fully qualified ROS service name, such as /plan_path."""

SessionId = NewType("SessionId", int)
"""64-bit number of one run of a sidecar; stands in the header of every datagram it sends."""

Version = NewType("Version", int)
"""Version of a pushed resource; only grows. 0 means none."""

Address = tuple[str, int]
"""IP address in its canonical text form and UDP port; IPv4-mapped IPv6 addresses are written as IPv4."""

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

MAX_VERSION = (1 << 63) - 1
"""Largest version of a resource: half of the field, so that a larger one can always be given out."""

MAX_PEERS = 4096
"""Peers of one sidecar: as many sidecars as a control plane registers."""

MAX_LATENCIES = 4096
"""Pairs (interface, server) in one report, counted anew for each service and size class that they carried."""

MAX_PATHS = 4096
"""Paths (interface, server) in one report."""

MAX_JOINTS = 1024
"""Pairs of paths in one report: 16 services, each over 8 interfaces in turn to a few servers. As many of interfaces."""

MAX_UNMET = 64
"""Services told of that a configuration names and nobody serves."""

MAX_GOODBYES = 64
"""Servers in one report that said goodbye."""

MAX_PENALTIES = 1024
"""Servers in one report whose answers could not be delivered."""


class Role(enum.Enum):
    """What a sidecar is for."""

    ROBOT = "robot"
    CLOUD = "cloud"


class CandidateKind(enum.Enum):
    """How an address was learnt."""

    HOST = "host"
    SERVER_REFLEXIVE = "srflx"


class ResourceKind(enum.Enum):
    """What the control plane pushes."""

    PEERS = "peers"
    MAPPING = "mapping"


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
    base: Version = Version(0)
    """Above 0: `peers` are those that are new or different since this version, and `removed` left since then."""
    more: bool = False
    """The next message goes on with this set."""


@dataclass(frozen=True, slots=True)
class Assignment:
    """Requests go over `interface` to `server`."""

    interface: InterfaceName
    server: NodeName


@dataclass(frozen=True, slots=True)
class ServiceMapping:
    """Where one service's requests go, and why."""

    service: ServiceName
    assignments: tuple[Assignment, ...]
    predicted_miss: float = 1.0
    reason: str = ""
    explore: Assignment | None = None
    """A pair beside the assignments, of which a few requests would teach most; None if nothing is worth it."""


@dataclass(frozen=True, slots=True)
class MappingSet:
    """The mapping of all services of one robot at one version."""

    version: Version
    nonce: int
    services: tuple[ServiceMapping, ...] = ()


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
    peers_version: Version = Version(0)
    mapping_version: Version = Version(0)
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
    """Over candidates, serial and session, for the peers (`protos/trust/candidate_signature.py`); none in insecure mode."""
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


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """Renews the lease, as every other message does."""


@dataclass(frozen=True, slots=True)
class Drain:
    """The sidecar finishes what is in flight and goes."""


@dataclass(frozen=True, slots=True)
class Welcome:
    """The control plane's answer to a registration, sent again when any of it changes.

    `stun_servers` are host:port strings, `crl` what the fleet's CAs have revoked (PEM, signed by them; may be empty).
    """

    lease_s: float
    report_interval_s: float
    stun_servers: tuple[str, ...] = ()
    crl: bytes = field(default=b"", repr=False)
    reconnect_max_s: float = 0.0
    """The most between two attempts to connect again; 0: not told."""


@dataclass(frozen=True, slots=True)
class Ack:
    """`version` was applied."""

    resource: ResourceKind
    version: Version
    nonce: int


@dataclass(frozen=True, slots=True)
class Nack:
    """What was sent with `nonce` is refused; `version` is still in force."""

    resource: ResourceKind
    version: Version
    nonce: int
    error: str


@dataclass(frozen=True, slots=True)
class LatencyReport:
    """What requests of one service and size class took over one interface to one server since the last report.

    Beside the histograms, which know a time when it is over: how many of `requests` missed the service's deadline,
    known when that is over.
    """

    interface: InterfaceName
    server: NodeName
    service: ServiceName
    size_class: int
    """See `protos.base.size_class`."""
    network: Histogram
    """From sending to the answer, without the processing; lost is what the server never had whole."""
    called_off: Histogram
    """When copies were called off that the server did not have yet: the network takes longer than that."""
    processing: Histogram
    """The server's share; lost is what it had and did not answer."""
    requests: int = 0
    missed: int = 0


@dataclass(frozen=True, slots=True)
class PathReport:
    """State of one path, and its round-trip times since the last report."""

    interface: InterfaceName
    server: NodeName
    up: bool
    rtt: Histogram
    datagrams_sent: int = 0
    datagrams_lost: int = 0


@dataclass(frozen=True, slots=True)
class OutcomeReport:
    """What became of the requests for one service since the last report."""

    service: ServiceName
    ok: int = 0
    deadline_missed: int = 0
    failed: int = 0


@dataclass(frozen=True, slots=True)
class JointReport:
    """Requests sent over two paths at once since the last report, and how many missed the deadline on both."""

    service: ServiceName
    first: Assignment
    second: Assignment
    requests: int
    both_missed: int


@dataclass(frozen=True, slots=True)
class InterfaceJointReport:
    """Requests that went over two interfaces at once since the last report, and how many missed the deadline on both.

    An interface over which no path is up counts as missed. Which one alone a request missed is known of full `races`
    only, in which no copy is called off before the deadline.
    """

    service: ServiceName
    first: InterfaceName
    second: InterfaceName
    server: NodeName | None
    """Of both copies; None for all other requests."""
    requests: int
    both_missed: int
    races: int
    only_first_missed: int
    only_second_missed: int


@dataclass(frozen=True, slots=True)
class PenaltyReport:
    """A server whose answers could not be delivered: whatever the mapping says, others go before it."""

    server: NodeName
    left_s: float
    """For how long yet."""
    bad_answers: int = 1
    """That it is penalised for; half of what lies two minutes back."""


@dataclass(frozen=True, slots=True)
class Report:
    """Everything a robot sidecar measured since its last report."""

    latencies: tuple[LatencyReport, ...] = ()
    paths: tuple[PathReport, ...] = ()
    outcomes: tuple[OutcomeReport, ...] = ()
    joints: tuple[JointReport, ...] = ()
    interface_joints: tuple[InterfaceJointReport, ...] = ()
    penalties: tuple[PenaltyReport, ...] = ()
    """All that are in force."""
    goodbyes: tuple[NodeName, ...] = ()
    """Servers that said goodbye to this robot and are listed yet, or were until its last report."""
    changes_only: bool = False
    """Whether it tells of no other paths than those that went up or down, and of nothing else that was measured."""
    continues: bool = False
    """Whether this is a further part of a report, which says nothing of penalties."""
    more: bool = False
    """Whether further parts of the report follow."""
    servers_before: frozenset[NodeName] = frozenset()
    """Servers of the paths in the parts before this one."""


SidecarMessage = Registration | CandidateSet | ServiceSet | Report | Ack | Nack | Heartbeat | Drain | RevocationSet
"""What a sidecar says on its stream; a Registration first, once."""

ControlMessage = Welcome | PeerSet | MappingSet
"""What the control plane says on a sidecar's stream."""
