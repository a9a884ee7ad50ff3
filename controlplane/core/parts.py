"""How likely a request misses its deadline on a path, put together from what the network takes and the server needs."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from controlplane.core.posterior import IGNORANCE, Estimate

if TYPE_CHECKING:
    from controlplane.core.compute import ServerTimes
    from controlplane.core.network import RobotNetwork
    from protos.model import InterfaceName, NodeName

MODEL_REQUESTS = 5.0
"""What an estimate from parts (network and processing) is worth in real requests of the very service ..."""

SHARED_REQUESTS = 15.0
"""... and at most more, if the path carried other services' requests of the same size ..."""

STRANGE_SERVER_REQUESTS = 2.0
"""... but at most this, if the server's own processing times are not known yet."""

MODEL_MAX_SAMPLES = 100.0
"""Probes or requests beyond which more of them do not bring the estimate from parts any nearer to 0 or 1."""


class Asked(NamedTuple):
    """Which requests, over which path."""

    network: RobotNetwork
    interface: InterfaceName
    server: NodeName
    sizes: tuple[tuple[int, float], ...]
    """(size class, share) of the requests."""
    deadline_s: float
    carried: float
    """Requests on this very path whose outcomes are counted elsewhere."""


def from_parts(asked: Asked, processing: ServerTimes, now: float) -> Estimate:
    """P(network + processing > deadline), as known without the requests that were carried.

    `IGNORANCE` where nothing is known of the network.
    """
    miss = samples = shared = 0.0
    for size_class, share in asked.sizes:
        missed = worth = 0.0
        counted = asked.carried * share
        for witness in asked.network.witnesses(asked.interface, asked.server, size_class, now, counted=counted):
            missed += witness.requests * witness.exceeds(processing.times, asked.deadline_s)
            worth += witness.requests
            samples += share * witness.samples
            shared += witness.requests if witness.itself else 0.0
        if not worth:
            return IGNORANCE
        miss += share * missed / worth
    samples = min(samples, MODEL_MAX_SAMPLES)
    mean = (samples * miss + IGNORANCE.misses) / (samples + IGNORANCE.weight)
    weight = MODEL_REQUESTS + min(shared, SHARED_REQUESTS)
    if processing.requests < STRANGE_SERVER_REQUESTS:
        weight = STRANGE_SERVER_REQUESTS
    return Estimate.of(min(mean, 1.0), min(weight, samples + IGNORANCE.weight))
