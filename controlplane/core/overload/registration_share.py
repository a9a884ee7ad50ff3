"""Limits members that register all the time: each registration is announced to all others and logged.

One beyond the member's share is refused: its sidecar tries again a little later, as after every refusal.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.controlplane.core.base.member_table import MemberTable
from plr.protos.base.token_bucket import TokenBucket

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName

STARTS_BURST = 30.0
"""A day of somebody who looks for a mistake, in minutes."""

STARTS_PER_S = 0.2
"""Rate after that. A start is announced to all others, with all that the member offers."""

RETURN_COST = 0.2
"""Cost, in starts, of a run that only connects again, which is not announced: one a second."""


class RegistrationShare:
    """Counts the registrations of each member. Times are monotonic seconds."""

    def __init__(self) -> None:
        self.shares = MemberTable(lambda now: TokenBucket(rate=STARTS_PER_S, burst=STARTS_BURST, now=now))

    def take(self, name: NodeName, now: float, *, new_run: bool) -> bool:
        """Count a registration; return False if that exceeds the member's share."""
        return self.shares.of(name, now).take(now, 1.0 if new_run else RETURN_COST)
