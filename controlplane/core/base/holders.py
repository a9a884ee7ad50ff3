"""Knows which owner holds most of what fills a table, so that the table's room is taken from that one.

A member that names ever new things then loses its own, and pushes out nothing of others. Every operation takes the same
time, however many owners there are.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Generic, TypeVar

K = TypeVar("K")


class Holders(Generic[K]):
    """Counts what each owner holds."""

    def __init__(self) -> None:
        self._counts: dict[K, int] = {}
        self._with: dict[int, OrderedDict[K, None]] = {}
        """Owners that hold this many, by that number, in the order in which they came to it."""
        self._most = 0

    def __contains__(self, owner: K) -> bool:
        return owner in self._counts

    def add(self, owner: K) -> None:
        """Count one more."""
        self._change(owner, 1)

    def remove(self, owner: K) -> None:
        """Count one fewer of an owner that holds any."""
        self._change(owner, -1)

    def greediest(self) -> K:
        """Return an owner that holds most: of several, the first that came to so many. KeyError without any."""
        return next(iter(self._with[self._most]))

    def _change(self, owner: K, by: int) -> None:
        before = self._counts.get(owner, 0)
        after = before + by
        if before:
            del self._with[before][owner]
            if not self._with[before]:
                del self._with[before]
        if after:
            self._counts[owner] = after
            self._with.setdefault(after, OrderedDict())[owner] = None
            self._most = max(self._most, after)
        else:
            del self._counts[owner]
        while self._most and self._most not in self._with:
            self._most -= 1
