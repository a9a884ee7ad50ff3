"""Holds the counters of the ROS bridge. Its one thread writes them; a scrape copies (`dict(...)`) before it iterates.

This file imports no rclpy, so that the metrics can be described where no ROS is installed.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plr.protos.model.ids import ServiceName


@dataclass(slots=True)
class BridgeStats:
    """What passed between the local ROS graph and the data plane."""

    requests_taken: Counter[ServiceName] = field(default_factory=Counter)
    """Robot: requests of local applications."""
    answers_sent: Counter[ServiceName] = field(default_factory=Counter)
    """Robot: answers given to local applications, late ones included."""
    unanswered: Counter[tuple[ServiceName, str]] = field(default_factory=Counter)
    """Robot: (service, reason): requests that will never be answered."""
    deadlines_missed: Counter[ServiceName] = field(default_factory=Counter)
    requests_sent: Counter[ServiceName] = field(default_factory=Counter)
    """Cloud: requests given to local servers."""
    answers_taken: Counter[ServiceName] = field(default_factory=Counter)
    """Cloud: answers of local servers, passed on."""
    refused: Counter[tuple[ServiceName, str]] = field(default_factory=Counter)
    """Cloud: (service, reason: RejectReason's name in lower case)."""
    abandoned: Counter[ServiceName] = field(default_factory=Counter)
    """Cloud: requests whose answer is no longer awaited."""
    fallbacks: Counter[tuple[ServiceName, str]] = field(default_factory=Counter)
    """Robot: (service, outcome: one of `plr.sidecar.core.robot.fallback.fallbacks.OUTCOMES`)."""
    fallback_up: dict[ServiceName, bool] = field(default_factory=dict)
    """Robot: whether the fallback of each service that has one can be called. Replaced, never changed."""
    fallback_takes_s: dict[ServiceName, float] = field(default_factory=dict)
    """Robot: seconds that the fallback of each such service is expected to take. Replaced, never changed."""
    dropped: Counter[str] = field(default_factory=Counter)
    """Dropped events and messages, by reason."""
    errors: Counter[str] = field(default_factory=Counter)
    """Failures of rmw or of the bridge itself, by place."""
    pending: int = 0
    """Robot: applications' requests without an answer. Cloud: requests at local servers or waiting for them."""
    answers_paced: int = 0
    """Robot: answers held back briefly so that the client's queue does not overflow."""
    requests_paced: int = 0
    """Cloud: requests held back so that the server's queue does not overflow."""
    scans: int = 0
    """Scans of the ROS graph."""
    left_alone: dict[ServiceName, tuple[str, ...]] = field(default_factory=dict)
    """Robot: offered services that other nodes already serve here, with those nodes. Replaced, never changed."""
    missing_types: dict[ServiceName, str] = field(default_factory=dict)
    """Services not carried because of their type, with that type. Replaced, never changed."""
    mismatched: frozenset[ServiceName] = frozenset()
    """Cloud: services with a server that rmw has not connected to us: its QoS is incompatible, or it is new."""
    silent: frozenset[ServiceName] = frozenset()
    """Cloud: services all of whose servers in the ROS graph ended or show no sign of life."""
    carried: frozenset[ServiceName] = frozenset()
    """Robot: proxied services that exist. Cloud: services offered to robots."""
    not_started: str = ""
    """Why ROS does not start, while it is tried again; empty otherwise."""
    left_out_peers: tuple[str, ...] = ()
    """Hosts of ROS_STATIC_PEERS without an address at the start."""
