"""Estimates how likely a request misses its deadline on a path, from what the network takes and the server needs."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from plr.controlplane.core.estimate.posterior import IGNORANCE, Estimate

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from plr.controlplane.core.estimate.network import RobotNetwork, Witness
    from plr.controlplane.core.estimate.processing import ServerTimes
    from plr.protos.model.ids import InterfaceName, NodeName

MODEL_REQUESTS = 5.0
"""Worth of an estimate from parts (network and processing), in real requests of the very service ..."""

SHARED_REQUESTS = 15.0
"""... and at most this much more if the path carried other services' requests of the same size ..."""

STRANGE_SERVER_REQUESTS = 2.0
"""... but at most this if the server's own processing times are not known yet."""

MODEL_MAX_SAMPLES = 100.0
"""Probes or requests beyond which more of them do not bring the estimate from parts nearer to 0 or 1."""


class Asked(NamedTuple):
    """Which requests to estimate, over which path."""

    interface: InterfaceName
    server: NodeName
    sizes: tuple[tuple[int, float], ...]
    """(size class, share) of the requests."""
    deadline_s: float


Parts = list[tuple[float, "list[tuple[Witness, float]]"]]
"""For each size class its share of the requests, and each witness with the miss probability it tells."""


def parts_of(asked: Asked, network: RobotNetwork, processing: ServerTimes, now: float) -> Parts:
    """Ask all witnesses of the path, given what the server needs."""
    times, deadline_s = processing.times, asked.deadline_s
    return [
        (
            share,
            [
                (witness, witness.exceeds(times, deadline_s))
                for witness in network.witnesses(asked.interface, asked.server, size_class, now)
            ],
        )
        for size_class, share in asked.sizes
    ]


def from_parts(parts: Parts, carried: float, known_requests: float) -> Estimate:
    """Return P(network + processing > deadline), without the requests that the path carried itself.

    `carried` counts the requests on this very path whose outcomes are counted elsewhere, `known_requests` those that
    the server's times rest on. Return `IGNORANCE` if nothing is known of the network.
    """
    miss = samples = shared = 0.0
    for share, told in parts:
        missed = worth = 0.0
        for witness, exceeds in told:
            requests, of_samples = witness.requests, witness.samples
            if witness.itself:
                requests = of_samples = requests - carried * share
                if requests <= 0.0:
                    continue
                shared += requests
            missed += requests * exceeds
            worth += requests
            samples += share * of_samples
        if not worth:
            return IGNORANCE
        miss += share * missed / worth
    samples = min(samples, MODEL_MAX_SAMPLES)
    mean = (samples * miss + IGNORANCE.misses) / (samples + IGNORANCE.weight)
    weight = MODEL_REQUESTS + min(shared, SHARED_REQUESTS)
    if known_requests < STRANGE_SERVER_REQUESTS:
        weight = STRANGE_SERVER_REQUESTS
    return Estimate.of(min(mean, 1.0), min(weight, samples + IGNORANCE.weight))


def slower_than(
    asked: Asked, network: RobotNetwork, processing: ServerTimes, seconds: NDArray[np.float64], now: float
) -> NDArray[np.float64] | None:
    """Return P(network + processing > s) for each s, as measured; None if nothing is known of the network."""
    slower = np.zeros(len(seconds))
    for size_class, share in asked.sizes:
        missed = np.zeros(len(seconds))
        worth = 0.0
        for witness in network.witnesses(asked.interface, asked.server, size_class, now):
            missed += witness.requests * witness.exceeds_each(processing.times, seconds)
            worth += witness.requests
        if not worth:
            return None
        slower += share * missed / worth
    return slower
