"""What happened in the fleet, and who is gone, as the control plane keeps it for the operator."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from protos.model.ids import NodeName, Role, ServiceName


class Why(enum.Enum):
    """Why a sidecar is gone, or as good as gone."""

    LEASE_EXPIRED = "lease_expired"
    """Silent for longer than its lease: it crashed, lost its power, or every way to the control plane."""
    CERTIFICATE_EXPIRED = "certificate_expired"
    REVOKED = "revoked"
    DRAINED = "drained"
    """It said goodbye, finished what was in flight, and ended its stream."""
    LEFT = "left"
    """It said goodbye, and fell silent before it had finished."""
    POLICY = "policy"
    """It is connected, but the access policy leaves it nobody to talk to."""


class EventKind(enum.Enum):
    """What happened."""

    STARTED = "started"
    """The control plane."""
    STOPPED = "stopped"
    """The control plane, in order."""
    CONNECTED = "connected"
    STREAM_LOST = "stream_lost"
    """Its control stream ended; its lease has not."""
    DEPARTED = "departed"
    REFUSED = "refused"
    """A connection or a registration of a member."""
    NACK = "nack"
    """It does not take what it was sent."""
    OFFERS_REFUSED = "offers_refused"
    """It offers what the policy does not let it."""
    UNMET = "unmet"
    """Its configuration names services that nobody serves."""
    POLICY = "policy"
    """Another policy is in force."""
    CUT_OFF = "cut_off"
    """The policy leaves it nobody to talk to."""
    REJOINED = "rejoined"
    """The policy lets it talk to somebody again."""


@dataclass(frozen=True, slots=True)
class FleetEvent:
    """Something that happened."""

    number: int
    """Only grows, also over restarts."""
    at: float
    """Seconds since 1970, by the control plane's clock."""
    kind: EventKind
    node: NodeName | None = None
    """Whom it is about; None: the control plane itself."""
    text: str = ""
    """More about it, for people."""
    role: Role | None = None
    why: Why | None = None
    """Of a departure."""
    seen_at: float | None = None
    """When one that departed was heard of last, by the same clock."""


@dataclass(frozen=True, slots=True)
class EventLogState:
    """How the log of events is doing; what is not in it is counted here."""

    kept: int = 0
    evicted: int = 0
    """Old ones that made room."""
    too_often: int = 0
    """Not taken: one member had more of them than its share."""
    damaged: int = 0
    """Lines of the file that say nothing (any more)."""
    write_failures: int = 0
    on_disk: bool = False
    """Whether all of them are."""
    problem: str = ""
    """Why not, if they should be."""


@dataclass(frozen=True, slots=True)
class EventQuery:
    """Which events are asked for."""

    node: NodeName | None = None
    after: int = 0
    """Those with a larger number."""
    since: float = 0.0
    """Not before this time, in seconds since 1970."""
    last: int = 0
    """So many of these, the newest; 0: all."""


@dataclass(frozen=True, slots=True)
class EventList:
    """Events, the oldest first, and how many older ones `last` left out."""

    events: tuple[FleetEvent, ...]
    left_out: int
    log: EventLogState


@dataclass(frozen=True, slots=True)
class DepartedSidecar:
    """One that is gone, and what was known of it last."""

    name: NodeName
    role: Role
    why: Why
    gone_s: float
    """Since when."""
    seen_s: float
    """Since it said anything."""
    text: str = ""
    software_version: str = ""
    services: tuple[ServiceName, ...] = ()
    """Those that it offered or carried, the first of them."""
