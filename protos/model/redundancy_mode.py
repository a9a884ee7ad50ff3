"""Defines how many copies of a service's requests are sent, and when."""

from __future__ import annotations

import enum

DEFAULT_HEDGE_QUANTILE = 0.95
"""As in The Tail at Scale (Dean and Barroso 2013): about 5 % more load."""
DEFAULT_ADAPTIVE_TARGET = 0.001
"""One request in a thousand may miss, as far as a second copy can prevent it."""


class RedundancyMode(enum.Enum):
    """From the cheapest to the surest."""

    SINGLE = "single"
    """Over the best mapped pair; another copy only in place of one that a server refused or took down with it."""
    BACKUP = "backup"
    """The same, and the next pair as soon as the best one's path is unstable or down, or loses the request."""
    HEDGE = "hedge"
    """The same, and the next pair when the answer takes longer than it mostly does (a hedged request)."""
    ADAPTIVE = "adaptive"
    """Over the best mapped pair; others as late as keeps the target miss probability (`adaptive.py`)."""
    SHARE = "share"
    """Over all mapped interfaces together, to one server: each carries the part that it can, and spare capacity repeats
    what others carry (`message/sharing.py`)."""
    REPLICATE = "replicate"
    """Over every mapped pair at once (paper, section IV)."""

    @property
    def sends_late(self) -> bool:
        """Whether another copy is sent because the first is, or may be, slow."""
        return self in (RedundancyMode.HEDGE, RedundancyMode.ADAPTIVE)

    @property
    def uses_every_path(self) -> bool:
        """Whether every mapped interface carries something of a request from the start."""
        return self in (RedundancyMode.SHARE, RedundancyMode.REPLICATE)

    @property
    def helps(self) -> bool:
        """Whether another copy may be sent while one is awaited."""
        return self is not RedundancyMode.SINGLE
