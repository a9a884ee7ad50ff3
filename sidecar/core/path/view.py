"""Describes the state of a path at one moment, for people, as `plr doctor` shows it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plr.protos.model.ids import Address
    from plr.sidecar.core.base.values import PathId, PathState
    from plr.sidecar.core.path.path import Path
    from plr.sidecar.core.path.recent_loss import Recent


@dataclass(frozen=True, slots=True)
class PathView:
    """One path. It is read field by field while its thread goes on, so two fields may be a datagram apart."""

    id: PathId
    state: PathState
    remote: Address | None
    """Where the path leads."""
    candidates: int
    """Number of known addresses at which the peer may be."""
    smoothed_rtt_s: float
    """0 while unknown."""
    sent: int
    """Datagrams since the path is known."""
    lost: int
    spurious: int
    """Lost datagrams that were acknowledged after all."""
    recent: Recent
    """What was sent and lost in the last minute or so."""
    max_datagram: int
    """Bytes of UDP payload that the path is known to carry."""
    proven_at: float
    """When its peer last proved that it lives, or when the path was made (monotonic, s)."""
    used_at: float
    """When something other than probes last travelled, or when the path was made (monotonic, s)."""
    probe_every_s: float
    """Approximate time between probes while the path is up."""


def view_of(path: Path, now: float) -> PathView:
    """Return the current view of `path`."""
    recovery, probing = path.recovery, path.probing
    sent, lost, spurious = recovery.total_sent, recovery.total_lost, recovery.reordering.spurious
    return PathView(
        path.id,
        path.state,
        path.remote,
        len(path.candidates),
        recovery.rtt.smoothed,
        sent,
        lost,
        spurious,
        path.recent_loss.until(sent, lost - spurious, now),
        path.mtu.size,
        probing.proven_at,
        probing.used_at,
        probing.pause(now),
    )
