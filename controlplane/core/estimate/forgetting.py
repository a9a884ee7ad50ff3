"""When what was measured is forgotten: names of robots and servers come and go without end, and tables must not keep
them all, be these small enough or not.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections import OrderedDict
    from collections.abc import Callable

K = TypeVar("K")
V = TypeVar("V")

FORGET_S = 3600.0
"""At least so long is kept what is not reported any more: who is back after a break finds its past."""

FORGET_HALF_LIVES = 30.0
"""And for so many half-lives: of a billion samples one is left then."""


def forget_after_s(half_life_s: float) -> float:
    """How long what fades with this half-life is kept after it was added to last."""
    return max(FORGET_S, FORGET_HALF_LIVES * half_life_s)


def forget_before(table: OrderedDict[K, V], since: float, at: Callable[[V], float]) -> None:
    """Take out of a table, which is in the order of `at`, what is older."""
    while table and at(next(iter(table.values()))) < since:
        table.popitem(last=False)
