"""Holds the plain counters that the cores keep and `sidecar/observe/metrics.py` reads at scrape time.

Each object has one writer (a link's thread, or the engine's current holder). A scrape reads it without a lock, which in
CPython is safe for ints and dicts if the reader copies (`dict(...)`) before it iterates.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plr.protos.base.histogram import Histogram
    from plr.protos.model.ids import InterfaceName, NodeName, ServiceName


@dataclass(slots=True)
class PathStats:
    """One path, as measured by its own probes and acknowledgements."""

    up: bool = False
    srtt_s: float = 0.0
    datagrams_sent: int = 0
    datagrams_lost: int = 0
    spurious_losses: int = 0
    """Lost datagrams that were acknowledged after all."""
    bytes_sent: int = 0
    max_datagram: int = 0
    """Bytes of UDP payload."""
    key_phase: int = 0
    """Number of changes of the keys that seal what we send."""


@dataclass(slots=True)
class LinkStats:
    """One interface. Only its thread writes it."""

    interface: InterfaceName
    datagrams: Counter[tuple[str, str]] = field(default_factory=Counter)
    """(direction: sent | received, kind: data | repair | repeat | control | stun).

    Received repair and repeated symbols count as data.
    """
    dropped: Counter[str] = field(default_factory=Counter)
    """Datagrams by reason for the drop, received and unsendable ones alike."""
    bytes: Counter[str] = field(default_factory=Counter)
    """Direction: sent | received; UDP payload bytes."""
    paths: dict[NodeName, PathStats] = field(default_factory=dict)
    """The best path to each peer."""
    hangs: int = 0
    """Times that the interface's driver did not return for long."""
    offload: dict[str, bool] = field(default_factory=dict)
    """Direction: send | receive; whether the kernel cuts or joins datagrams for this socket."""


@dataclass(slots=True)
class EngineStats:
    """The requests. Only the engine's current holder writes it."""

    requests: Counter[tuple[ServiceName, str]] = field(default_factory=Counter)
    """(service, outcome: ok | deadline_missed | failed | rejected)."""
    durations: dict[ServiceName, Histogram] = field(default_factory=dict)
    """Seconds from submit to the first response, since start."""
    wins: Counter[tuple[InterfaceName, NodeName, ServiceName]] = field(default_factory=Counter)
    duplicate_responses: int = 0
    called_off: Counter[tuple[InterfaceName, NodeName, ServiceName]] = field(default_factory=Counter)
    """Copies no longer awaited because another won."""
    explored: Counter[tuple[InterfaceName, NodeName, ServiceName]] = field(default_factory=Counter)
    """Copies sent over paths that the mapping does not use, to measure them."""
    hedged: Counter[tuple[InterfaceName, NodeName, ServiceName]] = field(default_factory=Counter)
    """Copies sent because another took long."""
    copy_bytes: Counter[tuple[InterfaceName, ServiceName, str]] = field(default_factory=Counter)
    """(interface, service, copy: first | extra); bytes of messages, see `plr.sidecar.core.robot.dispatch.budgets`."""
    copies_refused: Counter[tuple[InterfaceName, ServiceName, str]] = field(default_factory=Counter)
    """(interface, service, limit: load | day); copies that a budget forbade."""
    bad_answers: Counter[tuple[NodeName, ServiceName]] = field(default_factory=Counter)
    """Answers that could not be delivered."""
    late_dropped: Counter[ServiceName] = field(default_factory=Counter)
    executions: Counter[tuple[ServiceName, str]] = field(default_factory=Counter)
    """Cloud: (service, result: run | coalesced | cached | cancelled | refused | abandoned)."""
    revocations: Counter[str] = field(default_factory=Counter)
    """Revocation lists exchanged with peers: asked | sent | received | taken."""
    dropped: Counter[str] = field(default_factory=Counter)
    """Messages and table entries by reason for the drop."""
    mapping_version: int = 0
    peers_version: int = 0
    nacks: int = 0
    in_flight: int = 0
