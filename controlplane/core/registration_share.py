"""Members that register all the time: each registration is told to all others and logged, so each has its share.

One beyond it is refused: its sidecar tries again a little later, as after every refusal.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING

from protos.token_bucket import TokenBucket

if TYPE_CHECKING:
    from protos.model import NodeName

STARTS_BURST = 30.0
"""A day of somebody who looks for a mistake, in minutes."""

STARTS_PER_S = 0.2
"""After that. All others are told of a start, with all that the member offers."""

RETURN_COST = 0.2
"""Of a run that only connects again, of which nobody need be told, in starts: one a second."""

MAX_MEMBERS = 8192
"""Members whose registrations are counted, the one that registered longest ago goes: twice those that can be there."""


class RegistrationShare:
    """Counts the registrations of each member. Times are monotonic seconds."""

    def __init__(self) -> None:
        self._shares: OrderedDict[NodeName, TokenBucket] = OrderedDict()

    def take(self, name: NodeName, now: float, *, new_run: bool) -> bool:
        """Count a registration; False if that is more than the member's share."""
        share = self._shares.get(name)
        if share is None:
            share = self._shares[name] = TokenBucket(rate=STARTS_PER_S, burst=STARTS_BURST, now=now)
            if len(self._shares) > MAX_MEMBERS:
                self._shares.popitem(last=False)
        self._shares.move_to_end(name)
        return share.take(now, 1.0 if new_run else RETURN_COST)
