"""The status of all sidecars as text for a terminal."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from controlplane.text_table import columns
from protos.model import Role
from protos.status import SyncState

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from protos.model import PathReport, ServiceMapping
    from protos.status import ResourceStatus, SidecarStatus

_HEADER = ("NAME", "ROLE", "STREAM", "LEASE", "PEERS", "MAPPING", "SERVICES", "SOFTWARE")


def render(sidecars: Sequence[SidecarStatus]) -> str:
    """One row a sidecar, then what each robot was told and on which paths it rests."""
    if not sidecars:
        return "no sidecars"
    lines = [*columns([_HEADER, *(_row(status) for status in sidecars)])]
    for status in sidecars:
        details = [*_details(status)]
        if details:
            lines += ["", f"{status.peer.name}:", *(f"  {line}" for line in details)]
    return "\n".join(lines)


def _row(status: SidecarStatus) -> tuple[str, ...]:
    stream = "open" if status.connected else "lost"
    if status.peer.draining:
        stream = "leaving"
    services = [offer.name for offer in status.peer.offers] + [use.name for use in status.uses]
    return (
        status.peer.name,
        status.peer.role.value,
        stream,
        f"{status.lease_left_s:.1f} s",
        status.peers.state.value,
        status.mapping.state.value if status.peer.role is Role.ROBOT else "-",
        ",".join(services) or "-",
        status.software_version or "-",
    )


def _details(status: SidecarStatus) -> Iterator[str]:
    for name, resource in (("peers", status.peers), ("mapping", status.mapping)):
        if resource.state is SyncState.REJECTED:
            yield f"{name} {_rejection(resource)}"
    if status.refused_offers:
        yield f"REFUSED by the policy: {', '.join(status.refused_offers)} (offered here, told to no robot)"
    for mapping in status.services:
        yield _mapping(mapping)
    for use in status.uses:
        if use.fallback_up is not None:
            state = "ready on the robot" if use.fallback_up else "MISSING: its node does not run, or has another type"
            yield f"{use.name}: fallback {state}"
    yield from columns([_path(path) for path in status.paths])


def _rejection(resource: ResourceStatus) -> str:
    kept = f"keeps {resource.version_acked}" if resource.version_acked else "holds none"
    return f"REJECTED version {resource.version_sent}, {kept}: {resource.error}"


def _mapping(mapping: ServiceMapping) -> str:
    pairs = ", ".join(f"{assignment.interface} -> {assignment.server}" for assignment in mapping.assignments)
    return f"{mapping.service}: {pairs or 'nowhere'} (predicted miss {mapping.predicted_miss:.3g}; {mapping.reason})"


def _path(path: PathReport) -> tuple[str, ...]:
    median = path.rtt.quantile(0.5)
    rtt = f"rtt {median * 1000:.1f} ms" if math.isfinite(median) else "rtt -"
    lost = f"lost {path.datagrams_lost} of {path.datagrams_sent} since the last report"
    return (f"{path.interface} -> {path.server}", "up" if path.up else "DOWN", rtt, lost)
