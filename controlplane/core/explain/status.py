"""Tells the operator who is registered and how far each follows."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from plr.controlplane.core.formulation.block import interfaces_of
from plr.protos.model.status import SidecarStatus

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from plr.controlplane.core.estimate.estimator import Estimator
    from plr.controlplane.core.estimate.unanswered import Unanswered
    from plr.controlplane.core.explain.faults import Faults
    from plr.controlplane.core.policy.permits import Permits
    from plr.controlplane.core.publish.publisher import Publisher
    from plr.controlplane.core.registry.registry import Registry
    from plr.protos.model.ids import NodeName, ServiceName


def is_met(robot: NodeName, server: NodeName, registry: Registry, permits: Permits) -> bool:
    """Return whether a server is registered and the robot may talk to it: what it said of others may be over."""
    cloud = registry.get(server)
    return cloud is not None and permits.may_meet(robot, cloud)


def is_offered(robot: NodeName, service: ServiceName, registry: Registry, permits: Permits) -> bool:
    """Return whether a registered cloud offers a service and the robot may call it there."""
    group = permits.group(robot)
    return any(service in permits.of(group, cloud) for cloud in registry.offering(service))


def statuses(
    names: Iterable[NodeName],
    registry: Registry,
    publisher: Publisher,
    estimator: Estimator,
    permits: Permits,
    unanswered: Unanswered,
    faults: Faults,
    now: float,
    *,
    abridged: bool,
) -> Iterator[SidecarStatus]:
    """Yield the status of the registered sidecars of these names; `abridged`: shorter if all is in order."""
    for name in names:
        sidecar = registry.get(name)
        if sidecar is None:
            continue
        snapshots = publisher[name]
        services = snapshots.mapping.sent or ()
        announced = set(interfaces_of(sidecar))
        paths = tuple(
            path
            for path in estimator.paths(name)
            if path.interface in announced and is_met(name, path.server, registry, permits)
        )
        in_order = all(path.up for path in paths) and all(mapping.assignments for mapping in services)
        wrong = faults.of(name, announced | {label.interface for label in sidecar.down})
        shorter = abridged and in_order and not sidecar.down and not wrong
        yield SidecarStatus(
            peer=replace(sidecar.as_peer(), candidates=()) if shorter else sidecar.as_peer(),
            connected=sidecar.stream is not None,
            lease_left_s=max(0.0, registry.lease_end(name) - now),
            software_version=sidecar.registration.software_version,
            uses=sidecar.uses,
            peers=snapshots.peers.status,
            mapping=snapshots.mapping.status,
            services=() if shorter else services,
            paths=() if shorter else paths,
            refused_offers=permits.refused_offers(sidecar),
            revocations=sidecar.revocations,
            unmet=sidecar.unmet,
            untyped=sidecar.untyped,
            unreached=sidecar.unreached,
            down=tuple(label.interface for label in sidecar.down),
            faults=wrong,
            withdrawn=tuple(sorted(sidecar.withdrawn.difference(sidecar.unmet))),
            unanswered={
                offer.name: row for offer in sidecar.offers if (row := unanswered.row(sidecar.name, offer.name, now))
            },
            abridged=shorter,
        )
