"""Remembers which servers requests go to at present. Links are told, so that the paths to them do not rest."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName

ATTEND_EVERY_S = 0.5
"""While requests come, links are told this often: as often as a path in use is probed."""


class Attention:
    """The servers that links were told about less than ATTEND_EVERY_S ago."""

    __slots__ = ("_told", "_until")

    def __init__(self, now: float) -> None:
        self._told: frozenset[NodeName] = frozenset()
        self._until = now

    def needs(self, servers: frozenset[NodeName], now: float) -> bool:
        """Return whether links must be told that a request goes to some of these servers."""
        if now >= self._until:
            self._told = frozenset()
            self._until = now + ATTEND_EVERY_S
        if servers <= self._told:
            return False
        self._told |= servers
        return True
