"""Describes where the copies of a service's requests go.

Frozen values, without IO and without protobuf. Times are seconds (float), probabilities in [0, 1], unless a name says
otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plr.protos.model.ids import InterfaceName, NodeName, ServiceName, Version


@dataclass(frozen=True, slots=True)
class Assignment:
    """Requests go over `interface` to `server`."""

    interface: InterfaceName
    server: NodeName


@dataclass(frozen=True, slots=True)
class ServiceMapping:
    """Where one service's requests go, and why."""

    service: ServiceName
    assignments: tuple[Assignment, ...]
    predicted_miss: float = 1.0
    reason: str = ""
    explore: Assignment | None = None
    """A pair outside the assignments from which a few requests would teach most; None if none is worth it."""


@dataclass(frozen=True, slots=True)
class MappingSet:
    """The mapping of all services of one robot at one version."""

    version: Version
    nonce: int
    services: tuple[ServiceMapping, ...] = ()
