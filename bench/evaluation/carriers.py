"""Holds statistics of single networks, from published traces, for the generator to draw from.

They are fitted to the drives of "LEO Satellite vs. Cellular Networks" (CoNEXT 2023; uplink), the walks of mp-traces
and, for round-trip times and loss, the pings of the PAM 2025 multi-carrier data set. `python -m bench scenarios
--traces DIR` compares them with the traces.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

PROBABILITIES = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
"""Probabilities at which a carrier's rates are given; in between, the log of the rate is linear in the probability."""


@dataclass(frozen=True, slots=True)
class Carrier:
    """How one network's uplink rate, outages and round-trip time behave."""

    name: str
    rates_kbps: tuple[float, float, float, float, float, float, float]
    """Uplink rate outside of outages, at PROBABILITIES."""
    slow_share: float
    """Share of the rate's variance that changes slowly; the rest changes quickly. Both: first-order autoregressive."""
    slow_s: float
    """Seconds in which the slow part's autocorrelation falls to 1/e."""
    rtt_ms: float
    """Median of the base round-trip time."""
    fast_s: float = 3.0
    """The same for the quick part."""
    up_share: float = 1.0
    """Uplink rate over downlink rate."""
    rtt_sigma: float = 0.0
    """Standard deviation of the logarithm of the base round-trip time."""
    loss: float = 0.0
    """Probability that a packet is lost."""
    outage_every_s: float = math.inf
    """Mean seconds from the end of an outage (rate 0) to the start of the next."""
    outage_s: float = 1.0
    """Mean length of an outage, seconds; at least a step of the trace."""

    def rate_at(self, probability: Floats) -> Floats:
        """Return quantiles of the rate, kbit/s."""
        rates: Floats = np.exp(np.interp(probability, PROBABILITIES, np.log(self.rates_kbps)))
        return rates

    def probability_below(self, rate_kbps: float) -> float:
        """Return the share of time, outages aside, with a lower rate."""
        if rate_kbps <= self.rates_kbps[0]:
            return 0.0
        if rate_kbps > self.rates_kbps[-1]:
            return 1.0
        return float(np.interp(math.log(rate_kbps), np.log(self.rates_kbps), PROBABILITIES))

    def autocorrelation(self, lag_s: float) -> float:
        """Return the autocorrelation of the rate's normal score."""
        return self.slow_share * math.exp(-lag_s / self.slow_s) + (1 - self.slow_share) * math.exp(-lag_s / self.fast_s)

    @property
    def outage_share(self) -> float:
        """Share of time in outages."""
        return 0.0 if math.isinf(self.outage_every_s) else self.outage_s / (self.outage_s + self.outage_every_s)


ATT = Carrier(
    name="AT&T",
    rates_kbps=(120, 800, 5_800, 14_200, 26_000, 50_000, 66_000),
    slow_share=0.7,
    slow_s=100.0,
    up_share=0.27,
    rtt_ms=60.0,
    rtt_sigma=0.25,
    loss=0.001,
    outage_every_s=140.0,
    outage_s=1.4,
)
VERIZON = Carrier(
    name="Verizon",
    rates_kbps=(180, 640, 4_200, 15_200, 34_200, 51_700, 62_000),
    slow_share=0.85,
    slow_s=130.0,
    up_share=0.17,
    rtt_ms=52.0,
    rtt_sigma=0.2,
    loss=0.001,
    outage_every_s=400.0,
    outage_s=2.3,
)
STARLINK = Carrier(
    name="Starlink",
    rates_kbps=(900, 3_500, 10_000, 14_500, 17_600, 22_500, 27_000),
    slow_share=0.5,
    slow_s=30.0,
    fast_s=2.0,
    up_share=0.075,
    rtt_ms=44.0,
    rtt_sigma=0.2,
    loss=0.003,
    outage_every_s=60.0,
    outage_s=2.0,
)
FULL_5G = Carrier(
    name="5G",
    rates_kbps=(9_500, 31_000, 38_000, 41_500, 46_000, 60_000, 74_000),
    slow_share=0.55,
    slow_s=8.0,
    fast_s=1.0,
    rtt_ms=45.0,
    rtt_sigma=0.3,
    loss=0.0005,
)
OFFICE_WIFI = Carrier(
    name="Wi-Fi",
    rates_kbps=(1_500, 12_500, 40_000, 50_000, 53_300, 59_700, 74_000),
    slow_share=0.9,
    slow_s=11.0,
    fast_s=1.0,
    rtt_ms=15.0,
    rtt_sigma=0.4,
    loss=0.001,
    outage_every_s=240.0,
    outage_s=4.0,
)
EVEN_ATT = Carrier(
    name="AT&T",
    rates_kbps=(5_500, 8_000, 18_000, 26_000, 37_000, 52_000, 62_000),
    slow_share=0.7,
    slow_s=60.0,
    up_share=0.27,
    rtt_ms=60.0,
    rtt_sigma=0.2,
    loss=0.0005,
)
"""AT&T where its coverage is good."""
EVEN_VERIZON = Carrier(
    name="Verizon",
    rates_kbps=(6_000, 8_500, 22_000, 30_000, 38_000, 50_000, 60_000),
    slow_share=0.8,
    slow_s=60.0,
    up_share=0.17,
    rtt_ms=52.0,
    rtt_sigma=0.2,
    loss=0.0005,
)
"""Verizon where its coverage is good."""
