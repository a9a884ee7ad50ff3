"""Defines what leaves the core for one stream: messages, and its end."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plr.controlplane.core.registry.registry import StreamId
    from plr.protos.model.stream import ControlMessage


class CloseReason(enum.Enum):
    """Why the control plane ends a stream."""

    REPLACED = "replaced by a newer stream of this sidecar"
    LEASE_EXPIRED = "silent for longer than the lease"
    STOPPING = "the control plane is stopping"
    REVOKED = "the certificate is revoked"
    CERTIFICATE_ENDED = "the certificate is no longer valid"


@dataclass(frozen=True, slots=True)
class SendMessage:
    """A message for one stream; a newer one of the same type makes an unsent older one pointless."""

    stream: StreamId
    message: ControlMessage


@dataclass(frozen=True, slots=True)
class EndStream:
    """End this stream."""

    stream: StreamId
    reason: CloseReason
