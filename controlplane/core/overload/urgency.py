"""Limits how much of what is solved at once is for one robot.

A robot whose paths go up and down all the time, or that says so, is drawn and solved at once as often as its share
lasts, and after that with the next routine solving: others' news wait for it no longer than for anyone's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.controlplane.core.base.member_table import MemberTable
from plr.protos.base.token_bucket import TokenBucket

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName

PAIRS_BURST = 2000.0
"""Pairs (interface, server) of one robot that are drawn at once, those of all its services: a small robot's news some
50 times, those of one with 8 interfaces and 4 services on 16 servers 4 times."""

PAIRS_PER_S = 100.0
"""Rate after that."""

LEAST_PAIRS = 40
"""Minimum cost of a robot: each drawing is a picture of the whole fleet, too."""


class Urgency:
    """Counts what each robot has used. Times are monotonic seconds."""

    def __init__(self) -> None:
        self.shares = MemberTable(lambda now: TokenBucket(rate=PAIRS_PER_S, burst=PAIRS_BURST, now=now))
        self.held = 0
        """News that had to wait for a routine solving."""

    def take(self, robot: NodeName, pairs: int, now: float) -> bool:
        """Return whether this robot, which takes this many pairs to draw, may be drawn at once."""
        taken = self.shares.of(robot, now).take(now, min(max(pairs, LEAST_PAIRS), PAIRS_BURST))
        self.held += not taken
        return taken
