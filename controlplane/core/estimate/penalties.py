"""Keeps the servers that a robot's sidecar asks only as a last resort, because their answers could not be delivered.

A mapping that names such a server is not followed. So here, as there, other servers go before it: for this robot alone,
as nobody else confirms what it says.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.protos.model.report import PenaltyReport

if TYPE_CHECKING:
    from collections.abc import Collection

    from plr.protos.model.ids import NodeName

LONGEST_S = 600.0
"""No sidecar penalises a server for longer (`plr.sidecar.core.robot.dispatch.penalties`), whatever it reports."""


class ReportedPenalties:
    """Penalties that one robot reported last, and until when they hold. Times are monotonic seconds."""

    __slots__ = ("_until",)

    def __init__(self) -> None:
        self._until: dict[NodeName, tuple[float, int]] = {}

    def replace(self, told: Collection[PenaltyReport], now: float) -> bool:
        """Replace all that are in force; return True if the set of servers changed."""
        if not told and not self._until:
            return False
        before = self._until.keys()
        self._until = {
            one.server: (now + min(one.left_s, LONGEST_S), one.bad_answers) for one in told if one.left_s > 0.0
        }
        return self._until.keys() != before

    def in_force(self, now: float) -> dict[NodeName, PenaltyReport]:
        """Return those that still hold, by server."""
        return {
            server: PenaltyReport(server, until - now, bad_answers)
            for server, (until, bad_answers) in self._until.items()
            if until > now
        }
