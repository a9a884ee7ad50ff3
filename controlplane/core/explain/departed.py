"""Remembers who is gone, why, and what was last known: it is needed just when it would be forgotten.

Each name has one entry, so that no member can push out others', however often it leaves. What was known of a departed
robot (its last mapping, what that rested on, its paths) is kept by reference, for the last ones only. Times are
monotonic seconds.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING

from plr.controlplane.core.problem.problem import BlockKey
from plr.protos.model.fleet_events import DepartedSidecar, Why
from plr.protos.model.members import RemovalReason

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from plr.controlplane.core.estimate.network import PathRecord
    from plr.controlplane.core.formulation.block import BlockNotes, Picture
    from plr.controlplane.core.problem.plan import BlockPlan, Plan
    from plr.controlplane.core.problem.problem import Objective
    from plr.controlplane.core.publish.snapshots import Snapshots
    from plr.controlplane.core.registry.registry import Sidecar
    from plr.protos.model.ids import InterfaceName, NodeName, Role, ServiceName
    from plr.protos.model.mapping import ServiceMapping
    from plr.protos.model.status import ResourceStatus

MAX_DEPARTED = 4096
"""Departed sidecars remembered, as many as can be registered; the one that left longest ago is evicted."""

MAX_EXPLAINED = 256
"""Of these, robots whose last mapping can be explained; the one that left longest ago is evicted."""

MAX_PATHS_KEPT = 64
"""Paths kept of a departed robot, with their round trips (8 kB each): 8 interfaces to 8 servers."""

MAX_SERVICES_KEPT = 64
"""Services whose last mapping is kept of a departed robot."""

MAX_SERVICES_TOLD = 16
"""Services named of a departed sidecar."""

_WHY = {
    RemovalReason.LEASE_EXPIRED: Why.LEASE_EXPIRED,
    RemovalReason.EXPIRED: Why.CERTIFICATE_EXPIRED,
    RemovalReason.REVOKED: Why.REVOKED,
    RemovalReason.LEFT: Why.DRAINED,
    RemovalReason.FORBIDDEN: Why.POLICY,
}


@dataclass(frozen=True, slots=True)
class LastKnown:
    """What a robot's mapping was, and what it rested on, when it left."""

    sidecar: Sidecar
    paths: Mapping[tuple[InterfaceName, NodeName], PathRecord]
    mapping: tuple[ServiceMapping, ...]
    sync: ResourceStatus
    plans: Mapping[BlockKey, BlockPlan]
    notes: Mapping[BlockKey, BlockNotes]
    objective: Objective


@dataclass(frozen=True, slots=True)
class Departure:
    """A sidecar that is gone."""

    name: NodeName
    role: Role
    why: Why
    at: float
    seen_at: float
    """When it was last heard from."""
    text: str = ""
    software_version: str = ""
    services: tuple[ServiceName, ...] = ()


def last_known(
    robot: Sidecar,
    snapshots: Snapshots,
    paths: Mapping[tuple[InterfaceName, NodeName], PathRecord],
    picture: Picture,
    plan: Plan,
) -> LastKnown:
    """Gather it before it is forgotten elsewhere; keep references only, as many may leave at once."""
    keys = [BlockKey(robot.name, use.name) for use in robot.uses[:MAX_SERVICES_KEPT]]
    return LastKnown(
        sidecar=robot,
        paths=paths if len(paths) <= MAX_PATHS_KEPT else dict(islice(paths.items(), MAX_PATHS_KEPT)),
        mapping=snapshots.mapping.sent or (),
        sync=snapshots.mapping.status,
        plans={key: plan.blocks[key] for key in keys if key in plan.blocks},
        notes={key: picture.notes[key] for key in keys if key in picture.notes},
        objective=picture.problem.objective,
    )


def departure(sidecar: Sidecar, why: Why, text: str, *, at: float, seen_at: float) -> Departure:
    """Record the departure of a sidecar that was registered until now."""
    names = [offer.name for offer in sidecar.offers] + [use.name for use in sidecar.uses]
    return Departure(
        name=sidecar.name,
        role=sidecar.role,
        why=why,
        at=at,
        seen_at=seen_at,
        text=text,
        software_version=sidecar.registration.software_version,
        services=tuple(names[:MAX_SERVICES_TOLD]),
    )


def why_removed(sidecar: Sidecar, reason: RemovalReason) -> Why:
    """Return the reason in the operator's words."""
    if reason is RemovalReason.LEASE_EXPIRED and sidecar.draining:
        return Why.LEFT
    return _WHY[reason]


class Departed:
    """All sidecars that are gone, as far as remembered."""

    def __init__(self) -> None:
        self._departures: OrderedDict[NodeName, Departure] = OrderedDict()
        self._last_known: OrderedDict[NodeName, LastKnown] = OrderedDict()
        self.forgotten = 0
        """Departures that made room for later ones."""

    def __len__(self) -> int:
        return len(self._departures)

    def __iter__(self) -> Iterator[Departure]:
        return iter(self._departures.values())

    def note(self, gone: Departure, last: LastKnown | None = None) -> None:
        """Note that a sidecar is gone."""
        self.forget(gone.name)
        self._departures[gone.name] = gone
        if len(self._departures) > MAX_DEPARTED:
            name, _ = self._departures.popitem(last=False)
            self._last_known.pop(name, None)
            self.forgotten += 1
        if last is not None:
            self._last_known[gone.name] = last
            if len(self._last_known) > MAX_EXPLAINED:
                self._last_known.popitem(last=False)

    def forget(self, name: NodeName) -> Departure | None:
        """Forget a sidecar that is back; return what was noted of it."""
        self._last_known.pop(name, None)
        return self._departures.pop(name, None)

    def get(self, name: NodeName) -> Departure | None:
        """Return what is remembered of a departure."""
        return self._departures.get(name)

    def last_known(self, name: NodeName) -> LastKnown | None:
        """Return what was known of a robot when it left; None if that is forgotten."""
        return self._last_known.get(name)

    def told(self, now: float, limit: int) -> tuple[DepartedSidecar, ...]:
        """Return the last departures for the operator, the latest first."""
        return tuple(
            DepartedSidecar(
                name=gone.name,
                role=gone.role,
                why=gone.why,
                gone_s=max(0.0, now - gone.at),
                seen_s=max(0.0, now - gone.seen_at),
                text=gone.text,
                software_version=gone.software_version,
                services=gone.services,
            )
            for gone in islice(reversed(self._departures.values()), limit)
        )
