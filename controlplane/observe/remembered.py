"""Reads from the event log which members were gone, and which were present when the previous run ended."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.controlplane.core.explain.departed import Departure
from plr.protos.model.fleet_events import EventKind, FleetEvent, Why

if TYPE_CHECKING:
    from collections.abc import Sequence

    from plr.protos.model.ids import NodeName


def departures(
    events: Sequence[FleetEvent], *, ran_until: float | None, now_wall: float, now: float
) -> tuple[list[Departure], list[Departure]]:
    """Return the departures so far, the earliest first, and one for each member that was present, should it not return.

    `ran_until` is when the previous run ended and `now_wall` is now, both in seconds since 1970. `now` is the same
    moment in monotonic seconds, as used in the result.
    """
    gone: dict[NodeName, FleetEvent] = {}
    present: dict[NodeName, FleetEvent] = {}
    for event in events:
        node = event.node
        # A refused member was not present.
        if node is None or event.role is None or event.kind is EventKind.REFUSED:
            continue
        gone.pop(node, None)
        present.pop(node, None)
        (gone if event.kind is EventKind.DEPARTED else present)[node] = event
    # A member present in the log was heard from until that run ended; otherwise its departure would be logged.
    ended_at = now_wall if ran_until is None else ran_until

    def departure(event: FleetEvent, at_wall: float, seen_wall: float) -> Departure:
        at, seen_at = (now - max(0.0, now_wall - wall) for wall in (at_wall, seen_wall))
        assert event.node is not None
        assert event.role is not None
        text = event.text if event.kind is EventKind.DEPARTED else ""
        return Departure(event.node, event.role, event.why or Why.LEASE_EXPIRED, at, seen_at, text)

    return (
        [departure(event, event.at, event.at if event.seen_at is None else event.seen_at) for event in gone.values()],
        [departure(event, ended_at, ended_at) for event in present.values()],
    )
