"""Keeps something small for each member, such as its share of a resource that all use in turn.

Members choose their names, so there is room for twice as many as can be registered. The one that was looked up longest
ago is forgotten first, which is counted: what is kept of it begins afresh when it comes again.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

V = TypeVar("V")

MAX_MEMBERS = 8192


class MemberTable(Generic[V]):
    """Creates what it keeps with `make`, at a time in monotonic seconds."""

    def __init__(self, make: Callable[[float], V]) -> None:
        self._make = make
        self._kept: OrderedDict[str, V] = OrderedDict()
        self.forgotten = 0

    def __len__(self) -> int:
        return len(self._kept)

    def of(self, member: str, now: float) -> V:
        """Return what is kept of this member; create it if there is nothing."""
        kept = self._kept.get(member)
        if kept is None:
            kept = self._kept[member] = self._make(now)
            if len(self._kept) > MAX_MEMBERS:
                self._kept.popitem(last=False)
                self.forgotten += 1
        self._kept.move_to_end(member)
        return kept

    def get(self, member: str) -> V | None:
        """Return what is kept of this member, if anything is."""
        return self._kept.get(member)

    def values(self) -> Collection[V]:
        """Return what is kept of all."""
        return self._kept.values()
