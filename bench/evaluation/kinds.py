"""Defines the generator's kinds of scenario: two carriers, what they have in common, and what is sure to happen."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from bench.evaluation.carriers import (
    ATT,
    EVEN_ATT,
    EVEN_VERIZON,
    FULL_5G,
    OFFICE_WIFI,
    STARLINK,
    VERIZON,
    Carrier,
)

DEAD_ZONE_FACTOR = 0.05
"""Share of a rate that remains in a dead zone."""


@dataclass(frozen=True, slots=True)
class Blackout:
    """A period of rate 0 that every window of the kind has."""

    paths: str
    """`a`, `b` or `ab`."""
    begin: float
    """Share of the window before it."""
    end: float


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of scenario with two paths."""

    a: Carrier
    b: Carrier
    common: float = 0.0
    """Correlation of the processes that drive the two rates, 0 to 1."""
    dead_every_s: float = math.inf
    """Mean seconds between common dead zones, in which both rates fall to DEAD_ZONE_FACTOR."""
    dead_s: float = 10.0
    """Mean length of a dead zone, seconds."""
    blackouts: tuple[Blackout, ...] = ()
    step_s: float = 1.0

    @property
    def dead_share(self) -> float:
        """Share of time in dead zones."""
        return 0.0 if math.isinf(self.dead_every_s) else self.dead_s / (self.dead_s + self.dead_every_s)


KINDS = {
    "drive": Kind(ATT, VERIZON, common=0.2, dead_every_s=200.0, dead_s=15.0),
    "good_drive": Kind(EVEN_ATT, EVEN_VERIZON, common=0.1),
    "blind_spot": Kind(
        EVEN_ATT, EVEN_VERIZON, common=0.1, blackouts=(Blackout("a", 0.3, 0.4), Blackout("a", 0.65, 0.8))
    ),
    "handover": Kind(
        replace(EVEN_ATT, outage_every_s=15.0, outage_s=0.8),
        replace(EVEN_VERIZON, outage_every_s=20.0, outage_s=0.8),
        step_s=0.2,
    ),
    "indoor": Kind(OFFICE_WIFI, FULL_5G, step_s=0.2),
    "two_wifi": Kind(OFFICE_WIFI, replace(OFFICE_WIFI, rtt_ms=18.0), common=0.2, step_s=0.2),
    "satellite": Kind(ATT, STARLINK),
    "both_dark": Kind(
        ATT,
        VERIZON,
        common=0.2,
        blackouts=(Blackout("ab", 0.2, 0.27), Blackout("a", 0.5, 0.65), Blackout("ab", 0.6, 0.65)),
    ),
    "one_operator": Kind(
        EVEN_ATT,
        replace(EVEN_ATT, rtt_ms=50.0),
        common=0.95,
        dead_every_s=60.0,
        dead_s=8.0,
        # Both radios lose their cell, and once one of them alone: the possible gain is small, but not zero.
        blackouts=(Blackout("ab", 0.3, 0.35), Blackout("b", 0.5, 0.55), Blackout("ab", 0.7, 0.75)),
    ),
}
"""Kinds by the name that scenario files use."""
