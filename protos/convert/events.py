"""Converts fleet events and departed sidecars (admin.proto)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.protos.convert.fields import MAX_DURATION_S, MAX_REPORTED_COUNT, US_PER_S, at_most, each, known, microseconds
from plr.protos.convert.types import role_from_proto, role_to_proto, service_names
from plr.protos.model.fleet_events import (
    DepartedSidecar,
    EventKind,
    EventList,
    EventLogState,
    EventQuery,
    FleetEvent,
    Why,
)
from plr.protos.model.names import clean_text, node_name, text
from plr.protos.plr.v1 import admin_pb2, types_pb2

if TYPE_CHECKING:
    from collections.abc import Sequence

MAX_FLEET_EVENTS = 65_536
"""Events in one answer."""

MAX_LISTED_DEPARTED = 8192
"""Departed sidecars in one status."""

MAX_SERVICES = 1024
"""Services of one departed sidecar."""

MAX_AGE_US = round(MAX_DURATION_S * US_PER_S) * 36_525
"""A century: a longer age is a mistake of units."""

MAX_TIME_US = 253_402_300_799 * US_PER_S
"""The end of the year 9999."""

_WHY = {
    admin_pb2.DEPARTURE_REASON_LEASE_EXPIRED: Why.LEASE_EXPIRED,
    admin_pb2.DEPARTURE_REASON_CERTIFICATE_EXPIRED: Why.CERTIFICATE_EXPIRED,
    admin_pb2.DEPARTURE_REASON_REVOKED: Why.REVOKED,
    admin_pb2.DEPARTURE_REASON_DRAINED: Why.DRAINED,
    admin_pb2.DEPARTURE_REASON_LEFT: Why.LEFT,
    admin_pb2.DEPARTURE_REASON_POLICY: Why.POLICY,
}
_WHY_NUMBERS = {why: number for number, why in _WHY.items()}

_KINDS = {
    admin_pb2.EVENT_KIND_STARTED: EventKind.STARTED,
    admin_pb2.EVENT_KIND_STOPPED: EventKind.STOPPED,
    admin_pb2.EVENT_KIND_CONNECTED: EventKind.CONNECTED,
    admin_pb2.EVENT_KIND_STREAM_LOST: EventKind.STREAM_LOST,
    admin_pb2.EVENT_KIND_DEPARTED: EventKind.DEPARTED,
    admin_pb2.EVENT_KIND_REFUSED: EventKind.REFUSED,
    admin_pb2.EVENT_KIND_NACK: EventKind.NACK,
    admin_pb2.EVENT_KIND_OFFERS_REFUSED: EventKind.OFFERS_REFUSED,
    admin_pb2.EVENT_KIND_UNMET: EventKind.UNMET,
    admin_pb2.EVENT_KIND_POLICY: EventKind.POLICY,
    admin_pb2.EVENT_KIND_CUT_OFF: EventKind.CUT_OFF,
    admin_pb2.EVENT_KIND_REJOINED: EventKind.REJOINED,
    admin_pb2.EVENT_KIND_FLAPPING: EventKind.FLAPPING,
    admin_pb2.EVENT_KIND_USELESS: EventKind.USELESS,
    admin_pb2.EVENT_KIND_RECOVERED: EventKind.RECOVERED,
}
_KIND_NUMBERS = {kind: number for number, kind in _KINDS.items()}


def event_query_from_proto(message: admin_pb2.ListEventsRequest) -> EventQuery:
    """Check a query for events."""
    return EventQuery(
        node=node_name(message.node, "node") if message.node else None,
        after=message.after,
        since=at_most(message.since_us, MAX_TIME_US, "since_us") / US_PER_S,
        last=message.last,
    )


def event_query_to_proto(query: EventQuery) -> admin_pb2.ListEventsRequest:
    """Encode a query for events."""
    return admin_pb2.ListEventsRequest(
        node=query.node or "", after=query.after, since_us=microseconds(query.since), last=query.last
    )


def event_list_from_proto(message: admin_pb2.ListEventsResponse) -> EventList:
    """Check the answer to a query for events."""
    return EventList(
        events=events_from_proto(message.events),
        left_out=at_most(message.left_out, MAX_REPORTED_COUNT, "left_out"),
        log=log_state_from_proto(message.log),
    )


def events_from_proto(messages: Sequence[admin_pb2.FleetEvent]) -> tuple[FleetEvent, ...]:
    """Check events."""
    return each(messages, MAX_FLEET_EVENTS, "events", _event_from_proto)


def _event_from_proto(message: admin_pb2.FleetEvent) -> FleetEvent:
    return FleetEvent(
        number=message.number,
        at=at_most(message.at_us, MAX_TIME_US, "at_us") / US_PER_S,
        kind=known(message.kind, _KINDS, "kind"),
        node=node_name(message.node, "node") if message.node else None,
        text=text(message.text, "text"),
        role=role_from_proto(message.role) if message.role else None,
        why=why_from_proto(message.reason) if message.reason else None,
        seen_at=at_most(message.seen_us, MAX_TIME_US, "seen_us") / US_PER_S if message.seen_us else None,
    )


def event_to_proto(event: FleetEvent) -> admin_pb2.FleetEvent:
    """Encode an event."""
    return admin_pb2.FleetEvent(
        number=event.number,
        at_us=microseconds(event.at),
        kind=_KIND_NUMBERS[event.kind],
        node=event.node or "",
        role=role_to_proto(event.role) if event.role is not None else types_pb2.ROLE_UNSPECIFIED,
        reason=why_to_proto(event.why),
        text=clean_text(event.text),
        seen_us=microseconds(event.seen_at) if event.seen_at is not None else 0,
    )


def why_from_proto(value: admin_pb2.DepartureReason.ValueType) -> Why:
    """Check why a sidecar is gone."""
    return known(value, _WHY, "departure reason")


def why_to_proto(why: Why | None) -> admin_pb2.DepartureReason.ValueType:
    """Encode why a sidecar is gone; None: it is not."""
    return admin_pb2.DEPARTURE_REASON_UNSPECIFIED if why is None else _WHY_NUMBERS[why]


def departed_from_proto(messages: Sequence[admin_pb2.DepartedSidecar]) -> tuple[DepartedSidecar, ...]:
    """Check the departed sidecars."""
    return each(messages, MAX_LISTED_DEPARTED, "departed", _departed_from_proto)


def _departed_from_proto(message: admin_pb2.DepartedSidecar) -> DepartedSidecar:
    return DepartedSidecar(
        name=node_name(message.name, "name"),
        role=role_from_proto(message.role),
        why=why_from_proto(message.reason),
        gone_s=at_most(message.gone_us, MAX_AGE_US, "gone_us") / US_PER_S,
        seen_s=at_most(message.seen_us, MAX_AGE_US, "seen_us") / US_PER_S,
        text=text(message.text, "text"),
        software_version=text(message.software_version, "software_version"),
        services=service_names(message.services, MAX_SERVICES, "services"),
    )


def departed_to_proto(gone: DepartedSidecar) -> admin_pb2.DepartedSidecar:
    """Encode a departed sidecar."""
    return admin_pb2.DepartedSidecar(
        name=gone.name,
        role=role_to_proto(gone.role),
        reason=why_to_proto(gone.why),
        gone_us=microseconds(gone.gone_s),
        seen_us=microseconds(gone.seen_s),
        text=clean_text(gone.text),
        software_version=clean_text(gone.software_version),
        services=gone.services,
    )


def log_state_from_proto(message: admin_pb2.EventLogState) -> EventLogState:
    """Check the state of the event log."""
    return EventLogState(
        kept=at_most(message.kept, MAX_REPORTED_COUNT, "kept"),
        evicted=at_most(message.evicted, MAX_REPORTED_COUNT, "evicted"),
        too_often=at_most(message.too_often, MAX_REPORTED_COUNT, "too_often"),
        damaged=at_most(message.damaged, MAX_REPORTED_COUNT, "damaged"),
        write_failures=at_most(message.write_failures, MAX_REPORTED_COUNT, "write_failures"),
        on_disk=message.on_disk,
        problem=text(message.problem, "problem"),
    )


def log_state_to_proto(state: EventLogState) -> admin_pb2.EventLogState:
    """Encode the state of the event log."""
    return admin_pb2.EventLogState(
        kept=state.kept,
        evicted=state.evicted,
        too_often=state.too_often,
        damaged=state.damaged,
        write_failures=state.write_failures,
        on_disk=state.on_disk,
        problem=clean_text(state.problem),
    )
