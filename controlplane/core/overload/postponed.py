"""Counts leases put off because their sidecars' messages were not read yet: a sign that the control plane is late.

Or one member sends bytes that make no message: so each member counts a few times at most.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.controlplane.core.base.member_table import MemberTable
from plr.protos.base.token_bucket import TokenBucket

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName

COUNTED_BURST = 2.0
"""Times that one member counts at once."""

COUNTED_PER_S = 2.0 / 300.0
"""Rate after that: in the five minutes that the alert looks at, less than half of what triggers it."""


class Postponed:
    """Counts them. Times are monotonic seconds."""

    def __init__(self) -> None:
        self.shares = MemberTable(lambda now: TokenBucket(rate=COUNTED_PER_S, burst=COUNTED_BURST, now=now))
        self.counted = 0

    def note(self, name: NodeName, now: float) -> None:
        """Note that the lease of this member is postponed."""
        self.counted += self.shares.of(name, now).take(now)
