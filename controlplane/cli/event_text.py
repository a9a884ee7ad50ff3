"""Formats events and departures as text for a terminal."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING

from plr.controlplane.cli.text_table import columns, listed
from plr.protos.model.fleet_events import EventLogState, Why

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from plr.protos.model.fleet_events import DepartedSidecar, FleetEvent

SHOWN = 20
"""Departed sidecars shown in the text of a status."""

KEPT = (
    "lease_expired: peers may keep such a sidecar, and requests go on without the control plane; plr doctor on a peer "
    "says whether it is reached"
)
"""What the control plane cannot know of a sidecar that it does not hear."""

WORDS = {
    Why.LEASE_EXPIRED: "not heard by the control plane for longer than its lease",
    Why.CERTIFICATE_EXPIRED: "its certificate has expired",
    Why.REVOKED: "its certificate is revoked",
    Why.DRAINED: "it was stopped",
    Why.LEFT: "it was being stopped and fell silent",
    Why.POLICY: "the policy lets it talk to nobody",
}


def line(event: FleetEvent) -> str:
    """Return an event as one line."""
    at = datetime.fromtimestamp(event.at, UTC).strftime("%Y-%m-%d %H:%M:%S")
    who = event.node or "control plane"
    about = [f"{event.why.value}: {WORDS[event.why]}"] if event.why is not None else []
    if event.text:
        about.append(event.text)
    return f"{at}  {event.kind.value:<14}  {who:<20}  {'; '.join(about)}".rstrip()


def departed(gone: Sequence[DepartedSidecar], left_out: int) -> Iterator[str]:
    """Yield the sidecars that are gone, the last to go first."""
    if not gone:
        return
    yield "gone sidecars, newest first:"
    rows = [("NAME", "ROLE", "GONE FOR", "LAST SEEN", "WHY", "SERVICES", "SOFTWARE")]
    rows += [
        (
            one.name,
            one.role.value,
            age(one.gone_s),
            f"{age(one.seen_s)} ago",
            f"{one.why.value}: {one.text or WORDS[one.why]}",
            listed(one.services),
            one.software_version or "-",
        )
        for one in gone[:SHOWN]
    ]
    yield from (f"  {row}" for row in columns(rows))
    if any(one.why is Why.LEASE_EXPIRED for one in gone[:SHOWN]):
        yield f"  {KEPT}"
    left_out += max(0, len(gone) - SHOWN)
    if left_out:
        yield f"  and {left_out} more: plr events"


def events(last: Sequence[FleetEvent], state: EventLogState) -> Iterator[str]:
    """Yield the last events, and what is wrong with their log."""
    if last:
        yield "last events (plr events shows more):"
        yield from (f"  {line(event)}" for event in last)
    if state.problem:
        yield f"EVENTS ARE NOT WRITTEN TO DISK: {state.problem}"
    if state.damaged:
        yield f"{state.damaged} damaged lines of the event log were skipped"


def age(seconds: float) -> str:
    """Return a span of time in its largest unit."""
    for unit, length in (("d", 86_400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.0f} {unit}"
    return f"{seconds:.0f} s"
