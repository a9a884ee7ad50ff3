"""Robot side: tells links which servers requests go to at present, so that the paths to them do not rest."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from plr.sidecar.core.seam.links import Attend

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from plr.protos.model.ids import NodeName
    from plr.sidecar.core.seam.links import LinkCommand

ATTEND_EVERY_S = 0.5
"""While requests come, links are told this often: as often as a path in use is probed."""


class Attention:
    """The servers that links were told about less than ATTEND_EVERY_S ago."""

    __slots__ = ("_command", "_told", "_until")

    def __init__(self, command: Callable[[LinkCommand], None]) -> None:
        self._command = command
        self._told: frozenset[NodeName] = frozenset()
        self._until = -math.inf

    def ask_for(self, servers: Iterable[NodeName], now: float) -> None:
        """Tell links that a request goes to some of these servers, unless they know."""
        if now >= self._until:
            self._told = frozenset()
            self._until = now + ATTEND_EVERY_S
        if not self._told.issuperset(servers):
            wanted = frozenset(servers)
            self._told |= wanted
            self._command(Attend(wanted))
