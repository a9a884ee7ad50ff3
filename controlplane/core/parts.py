"""How likely a request misses its deadline on a path, put together from what the network takes and the server needs."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from controlplane.core.posterior import IGNORANCE, Estimate

if TYPE_CHECKING:
    from numpy.typing import NDArray

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


class _Parts(NamedTuple):
    """What the parts say."""

    exceeds: NDArray[np.float64]
    """P(network + processing > s) for each time s that was asked about."""
    samples: float
    shared: float
    """Requests of any service on the very path among them."""


def from_parts(asked: Asked, processing: ServerTimes, now: float) -> Estimate:
    """P(network + processing > deadline), as known without the requests that were carried.

    `IGNORANCE` where nothing is known of the network.
    """
    found = _put_together(asked, processing, np.array([asked.deadline_s]), now)
    if found is None:
        return IGNORANCE
    samples = min(found.samples, MODEL_MAX_SAMPLES)
    mean = (samples * float(found.exceeds[0]) + IGNORANCE.misses) / (samples + IGNORANCE.weight)
    weight = MODEL_REQUESTS + min(found.shared, SHARED_REQUESTS)
    if processing.requests < STRANGE_SERVER_REQUESTS:
        weight = STRANGE_SERVER_REQUESTS
    return Estimate.of(min(mean, 1.0), min(weight, samples + IGNORANCE.weight))


def slower_than(
    asked: Asked, processing: ServerTimes, seconds: NDArray[np.float64], now: float
) -> NDArray[np.float64] | None:
    """P(network + processing > s) for each s, as measured; None where nothing is known of the network."""
    found = _put_together(asked, processing, seconds, now)
    return found.exceeds if found is not None else None


def _put_together(asked: Asked, processing: ServerTimes, seconds: NDArray[np.float64], now: float) -> _Parts | None:
    exceeds = np.zeros(len(seconds))
    samples = shared = 0.0
    for size_class, share in asked.sizes:
        missed = np.zeros(len(seconds))
        worth = 0.0
        counted = asked.carried * share
        for witness in asked.network.witnesses(asked.interface, asked.server, size_class, now, counted=counted):
            missed += witness.requests * witness.exceeds(processing.times, seconds)
            worth += witness.requests
            samples += share * witness.samples
            shared += witness.requests if witness.itself else 0.0
        if not worth:
            return None
        exceeds += share * missed / worth
    return _Parts(exceeds, samples, shared)
