"""Divides a capped table among peers, so that one that fills it cannot lock the others out."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName

FORGOTTEN_AT_ONCE = 128
"""Old entries that a table forgets in one call; the rest waits for the next: under a millisecond after any burst."""


class Shares:
    """What each peer holds of `capacity` units.

    A peer may never hold more than what it leaves free for all others (dynamic threshold with alpha 1, Choudhury and
    Hahne 1998): alone it gets half, and beside any number of greedy ones there is always something left for the next.
    """

    __slots__ = ("_held", "capacity", "used")

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.used = 0
        self._held: dict[NodeName, int] = {}

    def held(self, peer: NodeName) -> int:
        """Return the units that this peer holds."""
        return self._held.get(peer, 0)

    def fits(self, peer: NodeName, units: int = 1) -> bool:
        """Return whether the peer may take this many more."""
        return self._held.get(peer, 0) + units <= self.capacity - self.used

    def take(self, peer: NodeName, units: int = 1) -> None:
        """Give the peer these units; the caller asks `fits` before."""
        if not units:
            return
        self._held[peer] = self._held.get(peer, 0) + units
        self.used += units

    def give_back(self, peer: NodeName, units: int = 1) -> None:
        """Return units that the peer took."""
        if not units:
            return
        left = self._held[peer] - units
        if left:
            self._held[peer] = left
        else:
            del self._held[peer]
        self.used -= units
