"""Who is registered and how far each follows, for the operator."""

from __future__ import annotations

from typing import TYPE_CHECKING

from protos.status import SidecarStatus

if TYPE_CHECKING:
    from collections.abc import Iterator

    from controlplane.core.estimator import Estimator
    from controlplane.core.permits import Permits
    from controlplane.core.publisher import Publisher
    from controlplane.core.registry import Registry


def statuses(
    registry: Registry, publisher: Publisher, estimator: Estimator, permits: Permits, now: float
) -> Iterator[SidecarStatus]:
    """Every registered sidecar, by name."""
    for sidecar in sorted(registry, key=lambda sidecar: sidecar.name):
        snapshots = publisher[sidecar.name]
        yield SidecarStatus(
            peer=sidecar.as_peer(),
            connected=sidecar.stream is not None,
            lease_left_s=max(0.0, registry.lease_end(sidecar.name) - now),
            software_version=sidecar.registration.software_version,
            uses=sidecar.uses,
            peers=snapshots.peers.status,
            mapping=snapshots.mapping.status,
            services=snapshots.mapping.sent or (),
            paths=tuple(estimator.paths(sidecar.name)),
            refused_offers=permits.refused_offers(sidecar),
            revocations=sidecar.revocations,
            unmet=sidecar.unmet,
        )
