"""Counters of the ROS bridge. Written by its one thread; a scrape copies (`dict(...)`) before it iterates.

This file imports no rclpy, so that the metrics can be described where no ROS is installed.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from protos.model.ids import ServiceName


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
    """Cloud: requests whose answer nobody waits for any more."""
    fallbacks: Counter[tuple[ServiceName, str]] = field(default_factory=Counter)
    """Robot: (service, outcome: one of `sidecar.core.robot.fallback.fallbacks.OUTCOMES`)."""
    fallback_up: dict[ServiceName, bool] = field(default_factory=dict)
    """Robot: services with a fallback; whether it can be asked. Replaced, never changed."""
    fallback_takes_s: dict[ServiceName, float] = field(default_factory=dict)
    """Robot: seconds that their fallbacks are expected to take. Replaced, never changed."""
    dropped: Counter[str] = field(default_factory=Counter)
    """Events and messages by the reason they were dropped for."""
    errors: Counter[str] = field(default_factory=Counter)
    """Failures of rmw or of the bridge itself, by where they happened."""
    pending: int = 0
    """Robot: applications' requests without an answer. Cloud: requests at local servers or waiting for them."""
    answers_paced: int = 0
    """Robot: answers held back for a moment so that the client's queue does not overflow."""
    requests_paced: int = 0
    """Cloud: requests held back so that the server's queue does not overflow."""
    scans: int = 0
    """Looks at the ROS graph."""
    left_alone: dict[ServiceName, tuple[str, ...]] = field(default_factory=dict)
    """Robot: offered services that other nodes already serve here, and those nodes. Replaced, never changed."""
    missing_types: dict[ServiceName, str] = field(default_factory=dict)
    """Services that are not carried because of their type, and that type. Replaced, never changed."""
    mismatched: frozenset[ServiceName] = frozenset()
    """Cloud: services with a server that rmw does not connect with us: its QoS does not fit, or it has just come."""
    silent: frozenset[ServiceName] = frozenset()
    """Cloud: services all of whose servers, as the ROS graph shows them, ended or show no sign of life."""
    carried: frozenset[ServiceName] = frozenset()
    """Robot: proxied services that exist. Cloud: services offered to robots."""
