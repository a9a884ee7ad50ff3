"""Describes what one direction of a link does to packets, as data."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from lab.errors import LabConfigError
from plr.controlplane.planning.traces import DEFAULT_QUEUE_BYTES

if TYPE_CHECKING:
    from collections.abc import Mapping


class DropReason(StrEnum):
    """Why the emulator lost a packet; each has its own counter."""

    LOSS = "loss"
    """Lost at random, with probability ``LinkProfile.loss``."""
    QUEUE_FULL = "queue_full"
    """The bottleneck's byte queue had no room (newest packet dropped); also during an outage."""
    BLACKHOLE = "blackhole"
    """Sent, queued or in flight while the link was a black hole."""
    UNPLUGGED = "unplugged"
    """Sent, queued or in flight while the cable was out."""
    IN_FLIGHT_FULL = "in_flight_full"
    """More packets in flight than the emulator stores: the scenario is beyond this lab."""
    INTERFACE_DOWN = "interface_down"
    """The receiving interface was down and refused the packet (with packet ports this is noticed some ms late)."""


@dataclass(frozen=True, slots=True)
class LinkProfile:
    """One direction of a link.

    A packet is lost with probability `loss` as it is sent. Survivors pass a first-in-first-out
    bottleneck of `rate_kbps` with `queue_bytes` of room, then propagate for `delay_ms` plus a draw,
    uniform in 0..`jitter_ms`. No packet ever overtakes another: order takes precedence over jitter.

    Raises:
        LabConfigError: a field is out of range.
    """

    delay_ms: float = 0.0
    """One-way propagation delay in milliseconds; >= 0."""
    jitter_ms: float = 0.0
    """Upper bound of the extra delay in milliseconds; >= 0. Never shortens `delay_ms`."""
    loss: float = 0.0
    """Probability that a packet is lost, 0..1."""
    rate_kbps: float | None = None
    """Bottleneck rate in kilobit/s of IP packets; None is unlimited; 0 is an outage: the queue fills, then drops."""
    queue_bytes: int = DEFAULT_QUEUE_BYTES
    """Queue in front of the bottleneck in bytes of IP packets, including the one being sent."""

    def __post_init__(self) -> None:
        for name, value in (("delay_ms", self.delay_ms), ("jitter_ms", self.jitter_ms)):
            if not (math.isfinite(value) and value >= 0):
                raise LabConfigError(f"{name}: expected a finite number >= 0, got {value!r}")
        if not 0 <= self.loss <= 1:
            raise LabConfigError(f"loss: expected a probability 0..1, got {self.loss!r}")
        if self.rate_kbps is not None and not (math.isfinite(self.rate_kbps) and self.rate_kbps >= 0):
            raise LabConfigError(f"rate_kbps: expected a finite number >= 0 or None, got {self.rate_kbps!r}")
        if self.queue_bytes < 0:
            raise LabConfigError(f"queue_bytes: expected >= 0, got {self.queue_bytes!r}")

    def to_json(self) -> dict[str, Any]:
        """Return field name -> value, ready for JSON."""
        return asdict(self)

    @classmethod
    def from_json(cls, fields: Mapping[str, Any]) -> LinkProfile:
        """Return the profile that `to_json` encoded.

        Raises:
            LabConfigError: a field is unknown, has the wrong type or a value out of range.
        """
        try:
            return cls(**fields)
        except TypeError as error:
            raise LabConfigError(f"link profile: {error}") from None
