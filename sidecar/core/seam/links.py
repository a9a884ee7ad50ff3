"""Defines the values that pass between a link (one interface, its own thread) and the engine (the requests)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping

    from plr.protos.model.ids import Address, InterfaceId, NodeName, SessionId
    from plr.protos.trust.credential import SessionCredential
    from plr.sidecar.core.base.values import PathId, PathState
    from plr.sidecar.core.crypto.key_schedule import PairKeys
    from plr.sidecar.core.message.symbols import MessageSymbols
    from plr.sidecar.core.wire.frame import Fragment


@dataclass(frozen=True, slots=True)
class LinkPeer:
    """A peer as a link needs to know it."""

    name: NodeName
    session: SessionId
    token: bytes = field(repr=False)
    """The token with which it introduces itself to us."""
    incarnation: int
    credential: bytes = field(repr=False)
    keys: PairKeys
    addresses: tuple[tuple[InterfaceId, tuple[Address, ...]], ...]
    """For each of the peer's interfaces, where it may be reached."""
    era: int = 0
    """How often the name passed to somebody new because its holder was revoked: the earlier sessions never return."""
    dormant: bool = False
    """Whether the control plane lost it and no path reached it: it is answered, but asked less and less often."""


@dataclass(frozen=True, slots=True)
class SetPeers:
    """Set all peers that may be talked to; a peer with a new session starts from scratch."""

    peers: tuple[LinkPeer, ...]
    removed: Mapping[NodeName, str] = field(default_factory=dict)
    """Why the control plane just removed some of those that may not be talked to any more, for people."""


@dataclass(frozen=True, slots=True)
class SetReady:
    """Set whether the interface may be used yet (its STUN succeeded, or no STUN server answers anybody)."""

    ready: bool


@dataclass(frozen=True, slots=True)
class SetCarrier:
    """Set whether the interface can carry anything; without carrier or address its paths are down at once, unprobed."""

    on: bool
    why_not: str = "no carrier"
    """For people."""


@dataclass(frozen=True, slots=True)
class ResetPaths:
    """Take all paths down until they answer again; what they carried goes back to the engine."""

    reason: str


@dataclass(frozen=True, slots=True)
class Rebind:
    """Handle changed addresses or gateways of the interface.

    What was measured on affected paths is void, and their peers must learn where we are.
    """

    lost: frozenset[str]
    """Local addresses that nothing leaves from any more."""
    rerouted: frozenset[int]
    """Families (4, 6) whose gateways changed."""


@dataclass(frozen=True, slots=True)
class SetCredential:
    """Introduce this session by this credential (encoded) from now on: it was signed again."""

    credential: bytes


@dataclass(frozen=True, slots=True)
class Seek:
    """Probe the paths to these peers that are down, however long they have been: a request waits for any of them."""

    peers: frozenset[NodeName]


@dataclass(frozen=True, slots=True)
class CheckPaths:
    """Probe what is up now, however idle: something other than datagrams gets no answer over this interface."""


@dataclass(frozen=True, slots=True)
class Attend:
    """Watch the paths to these peers, also resting ones: requests go there, so whether they live must be known soon."""

    peers: frozenset[NodeName]


@dataclass(frozen=True, slots=True)
class SetMtu:
    """Set the interface's MTU: bytes, IP header included."""

    mtu: int


@dataclass(frozen=True, slots=True)
class Ping:
    """Measure how long a path takes, for somebody on this host; the result is in `Link.pongs`."""

    path: PathId
    number: int
    """Names its owner; the link only repeats it."""
    size: int
    """Bytes of the datagram's UDP payload; more if a probe does not fit."""


@dataclass(frozen=True, slots=True)
class Send:
    """Send a whole message over this path."""

    path: PathId
    message: MessageSymbols


@dataclass(frozen=True, slots=True)
class Resend:
    """Send these symbols of a message over this path, which need not be the one that lost them."""

    path: PathId
    message: MessageSymbols
    indices: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class SendFinished:
    """Tell the peer that its message is complete."""

    path: PathId
    number: int
    at_once: bool = True
    """Otherwise with the next datagram, or after MAX_FINISHED_DELAY_S (link.py)."""


@dataclass(frozen=True, slots=True)
class SendAbandon:
    """Tell the peer that the rest of our message does not come."""

    path: PathId
    number: int


@dataclass(frozen=True, slots=True)
class SendForgotten:
    """Tell the peer that we dropped what we had of its message."""

    path: PathId
    number: int


@dataclass(frozen=True, slots=True)
class SendClose:
    """Tell all peers that we go away."""


PathCommand = Send | Resend | SendFinished | SendAbandon | SendForgotten
"""Commands for one path."""
LinkCommand = (
    SetPeers
    | SetCredential
    | SetReady
    | SetCarrier
    | ResetPaths
    | Rebind
    | Seek
    | CheckPaths
    | Attend
    | SetMtu
    | Ping
    | PathCommand
    | SendClose
)


class FragmentsReceived(NamedTuple):
    """Symbols came in one batch; their data views the received datagrams."""

    path: PathId
    session: SessionId
    """The peer's session: message numbers mean nothing beyond it."""
    fragments: list[Fragment]


@dataclass(frozen=True, slots=True)
class FragmentsLost:
    """These symbols of a message did not arrive over this path."""

    path: PathId
    message: MessageSymbols
    indices: tuple[int, ...]
    timed_out: bool = False
    """Nothing at all was heard in time: the path itself is suspect, not one datagram."""


@dataclass(frozen=True, slots=True)
class FinishedLost:
    """The path died with these FINISHED unacknowledged: the peer may not know that its messages are complete."""

    path: PathId
    numbers: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class MessageFinished:
    """The peer holds the whole message."""

    peer: NodeName
    number: int


@dataclass(frozen=True, slots=True)
class MessageAbandoned:
    """The peer does not send the rest of its message."""

    peer: NodeName
    session: SessionId
    number: int


@dataclass(frozen=True, slots=True)
class MessageForgotten:
    """The peer dropped what it had of our message."""

    peer: NodeName
    number: int


@dataclass(frozen=True, slots=True)
class PathChanged:
    """A path's liveness changed."""

    path: PathId
    state: PathState
    reason: str


@dataclass(frozen=True, slots=True)
class PathMtuChanged:
    """The longest datagram (bytes of UDP payload) that a path is known to carry; a path that goes down forgets it."""

    path: PathId
    max_datagram: int


@dataclass(frozen=True, slots=True)
class PathMeasured:
    """Round-trip times (s) and datagram counts of one path since the last such event."""

    path: PathId
    smoothed_rtt_s: float
    rtts_s: tuple[float, ...]
    sent: int
    lost: int
    arrived: int = 0
    """Acknowledged datagrams."""
    missed: int = 0
    """Datagrams found missing while others arrived."""
    policed: bool = False
    """A policer caused the losses so far; they end with the sending rate that caused them."""


@dataclass(frozen=True, slots=True)
class PeerRestarted:
    """Somebody who knows a peer's token for us introduced a newer session of it; the credential is not verified yet."""

    peer: NodeName
    credential: SessionCredential
    at_home: bool
    """Whether it came from where the peer is known to be."""


@dataclass(frozen=True, slots=True)
class PeerRenewed:
    """As `PeerRestarted`, for the current session with another certificate."""

    peer: NodeName
    credential: SessionCredential
    at_home: bool


@dataclass(frozen=True, slots=True)
class PeerClosed:
    """The peer said goodbye."""

    peer: NodeName
    session: SessionId


@dataclass(frozen=True, slots=True)
class PeerLied:
    """The peer acknowledged what was never sent: it wants more sent than it receives, or to where it is not."""

    peer: NodeName
    session: SessionId


LinkEvent = (
    FragmentsReceived
    | FragmentsLost
    | FinishedLost
    | MessageFinished
    | MessageAbandoned
    | MessageForgotten
    | PathChanged
    | PathMtuChanged
    | PathMeasured
    | PeerRestarted
    | PeerRenewed
    | PeerClosed
    | PeerLied
)
