"""Describes what happened in the fleet and who is gone, as the control plane keeps it for the operator."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName, Role, ServiceName


class Why(enum.Enum):
    """Why a sidecar is gone, or as good as gone."""

    LEASE_EXPIRED = "lease_expired"
    """Silent for longer than its lease: it crashed, or lost power or every way to the control plane."""
    CERTIFICATE_EXPIRED = "certificate_expired"
    REVOKED = "revoked"
    DRAINED = "drained"
    """It said goodbye, finished its requests in flight, and ended its stream."""
    LEFT = "left"
    """It said goodbye, but fell silent before it had finished."""
    POLICY = "policy"
    """It is connected, but the access policy lets it talk to nobody."""


class EventKind(enum.Enum):
    """What happened."""

    STARTED = "started"
    """The control plane."""
    STOPPED = "stopped"
    """The control plane, in an orderly shutdown."""
    CONNECTED = "connected"
    STREAM_LOST = "stream_lost"
    """Its control stream ended, but not its lease."""
    DEPARTED = "departed"
    REFUSED = "refused"
    """A connection or a registration of a member."""
    NACK = "nack"
    """It refuses what it was sent."""
    OFFERS_REFUSED = "offers_refused"
    """It offers services that the policy does not allow."""
    UNMET = "unmet"
    """Its configuration names services that nobody serves."""
    POLICY = "policy"
    """A new policy is in force."""
    CUT_OFF = "cut_off"
    """The policy lets it talk to nobody."""
    REJOINED = "rejoined"
    """The policy lets it talk to others again."""
    FLAPPING = "flapping"
    """Paths over one of its interfaces go up and down all the time."""
    USELESS = "useless"
    """One of its interfaces is up, but delivers nothing in time or loses most."""
    RECOVERED = "recovered"
    """One of its interfaces is neither any more."""


@dataclass(frozen=True, slots=True)
class FleetEvent:
    """Something that happened."""

    number: int
    """Number that only grows, even across restarts."""
    at: float
    """Seconds since 1970, by the control plane's clock."""
    kind: EventKind
    node: NodeName | None = None
    """The member concerned; None: the control plane itself."""
    text: str = ""
    """Details, for people."""
    role: Role | None = None
    why: Why | None = None
    """Reason of a departure."""
    seen_at: float | None = None
    """When a departed member was last heard from, by the same clock."""


@dataclass(frozen=True, slots=True)
class EventLogState:
    """State of the event log, with counts of events that are not in it."""

    kept: int = 0
    evicted: int = 0
    """Old events removed to make room."""
    too_often: int = 0
    """Events not taken because a member had more than its share."""
    damaged: int = 0
    """Unreadable lines of the file."""
    write_failures: int = 0
    on_disk: bool = False
    """Whether all events are on disk."""
    problem: str = ""
    """Why not, if they should be on disk."""


@dataclass(frozen=True, slots=True)
class EventQuery:
    """A selection of events."""

    node: NodeName | None = None
    after: int = 0
    """Only events with a larger number."""
    since: float = 0.0
    """Only events from this time on, in seconds since 1970."""
    last: int = 0
    """Only this many of these, the newest; 0: all."""


@dataclass(frozen=True, slots=True)
class EventList:
    """Events, oldest first, and how many older ones `last` left out."""

    events: tuple[FleetEvent, ...]
    left_out: int
    log: EventLogState


@dataclass(frozen=True, slots=True)
class DepartedSidecar:
    """A sidecar that is gone, and what was last known of it."""

    name: NodeName
    role: Role
    why: Why
    gone_s: float
    """How long it has been gone."""
    seen_s: float
    """Time since it last said anything."""
    text: str = ""
    software_version: str = ""
    services: tuple[ServiceName, ...] = ()
    """The first of the services that it offered or carried."""
