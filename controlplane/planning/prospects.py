"""Describes what sets of interfaces and servers would achieve, and finds the smallest that suffices.

This is the paper's LSC theorem turned into a tool. On commodity infrastructure one path misses a deadline with some
probability epsilon > 0 that nobody can remove. Copies over k paths that fail independently all miss with epsilon^k, so
finitely many paths meet every target above 0. How many depends on how independent the paths really are: `joint` is the
measured probability, `product` the one under independence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Sequence


@dataclass(frozen=True, slots=True)
class Prospect:
    """A set of paths: every request goes over `interfaces` interfaces, each copy to one of `servers` servers."""

    interfaces: int
    servers: int
    paths: str
    """The paths in words."""
    product: float
    """Predicted miss probability if paths fail independently."""
    joint: float
    """The miss probability as measured."""


class Source(Protocol):
    """A recording that predictions can be made from."""

    @property
    def title(self) -> str:
        """The basis of the predictions, in one line."""

    @property
    def requests(self) -> float:
        """Requests recorded for one set of paths; misses rarer than one in this many are a guess."""

    def prospects(self, deadline_s: float) -> list[Prospect]:
        """Return the best set for each number of interfaces and servers, the smallest first."""


def least_set(prospects: Sequence[Prospect], target: float) -> Prospect | None:
    """Return the set with the fewest interfaces and, among those, the fewest servers that is predicted to miss with at
    most probability `target`; None if there is none."""
    enough = [prospect for prospect in prospects if prospect.joint <= target]
    return min(enough, key=lambda found: (found.interfaces, found.servers, found.joint), default=None)


def paths_needed(epsilon: float, target: float) -> int | None:
    """Return how many independent paths that miss with `epsilon` each meet `target` together; None if no number does.

    k >= log(target) / log(epsilon), for 0 < target < 1 (docs/develop/theory.md).
    """
    if epsilon >= 1.0:
        return None
    if epsilon <= target:
        return 1
    # Rounding must not add a path where a power of epsilon equals the target.
    return math.ceil(math.log(target) / math.log(epsilon) - 1e-9)
