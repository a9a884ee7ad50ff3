"""What sets of interfaces and servers would give, and the least of them that is good enough.

This is the paper's LSC theorem turned into a tool. On commodity infrastructure one path misses a deadline with some
probability epsilon > 0 that nobody can remove; copies over k paths that fail independently all miss with epsilon^k, so
every target above 0 is met by finitely many. How independent paths really are decides how many: `joint` says what was
measured, `product` what independence would give.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Sequence


@dataclass(frozen=True, slots=True)
class Prospect:
    """Every request goes over `interfaces` interfaces, each copy to one of `servers` servers."""

    interfaces: int
    servers: int
    paths: str
    """Which, in words."""
    product: float
    """Predicted miss probability if paths fail independently."""
    joint: float
    """The same as measured."""


class Source(Protocol):
    """What was recorded."""

    @property
    def title(self) -> str:
        """What the predictions rest on, in one line."""

    @property
    def requests(self) -> float:
        """Requests recorded for one set of paths: rarer misses than one in so many are a guess."""

    def prospects(self, deadline_s: float) -> list[Prospect]:
        """For each number of interfaces and servers the best set, the smallest first."""


def least_set(prospects: Sequence[Prospect], target: float) -> Prospect | None:
    """The set with the fewest interfaces and, among those, servers whose predicted miss probability is at most
    `target`; None if there is none."""
    enough = [prospect for prospect in prospects if prospect.joint <= target]
    return min(enough, key=lambda found: (found.interfaces, found.servers, found.joint), default=None)


def paths_needed(epsilon: float, target: float) -> int | None:
    """How many paths that miss with `epsilon` each, independently, all miss with at most `target`; None: no number.

    k >= log(target) / log(epsilon), for 0 < target < 1 (docs/develop/theory.md).
    """
    if epsilon >= 1.0:
        return None
    if epsilon <= target:
        return 1
    # Rounding must not ask for one path more where a power of epsilon is the target itself.
    return math.ceil(math.log(target) / math.log(epsilon) - 1e-9)
