"""How a path is at one moment, for people: what `plr doctor` shows of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from protos.model.ids import Address
    from sidecar.core.base.values import PathId, PathState
    from sidecar.core.path.path import Path


@dataclass(frozen=True, slots=True)
class PathView:
    """One path; read field by field while its thread goes on, so that two of them may be a datagram apart."""

    id: PathId
    state: PathState
    remote: Address | None
    """Where it leads."""
    candidates: int
    """How many addresses of the peer are known, at which it may be."""
    smoothed_rtt_s: float
    """0 while none is known."""
    sent: int
    """Datagrams since the path is known."""
    lost: int
    spurious: int
    """Of the lost: acknowledged after all."""
    max_datagram: int
    """Bytes of UDP payload that it is known to carry."""
    proven_at: float
    """When its peer last proved that it lives, or the path was made (monotonic, s)."""
    used_at: float
    """When something other than probes last travelled, or the path was made (monotonic, s)."""
    probe_every_s: float
    """How often it is probed now, about, if it is up."""


def view_of(path: Path, now: float) -> PathView:
    """Return how `path` is."""
    recovery, probing = path.recovery, path.probing
    return PathView(
        path.id,
        path.state,
        path.remote,
        len(path.candidates),
        recovery.rtt.smoothed,
        recovery.total_sent,
        recovery.total_lost,
        recovery.reordering.spurious,
        path.mtu.size,
        probing.proven_at,
        probing.used_at,
        probing.pause(now),
    )
