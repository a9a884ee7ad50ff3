"""A time before which this host's clock is not believed: what has expired does not come back when the clock goes back.

The floor is the newest time that the fleet's CA is known to have signed: when a revocation list or a certificate was
made. A time counts only if it is not later than the clock says when it is seen. So a clock that jumps to next year and
back does no lasting harm, nor does a CA whose own clock is ahead; and no peer raises the floor by what it says.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from protos.trust.identity import Trust

SLACK_S = 300.0
"""A clock that is behind by no more is set a little; `plr ca` lets certificates begin as much in the past."""


class ClockFloor:
    """Times in seconds since 1970. Any thread may use it."""

    def __init__(
        self,
        wall: Callable[[], float],
        floor: float = 0.0,
        remember: Callable[[float], None] | None = None,
        alert: Callable[[str], None] | None = None,
    ) -> None:
        """`wall` is the host's clock, `floor` what an earlier run left.

        `remember` is told of each new floor, `alert` once in words when the clock falls behind it.
        """
        self._wall = wall
        self._floor = floor
        self._remember = remember
        self._alert = alert
        self._behind = False

    @property
    def floor(self) -> float:
        """The newest time that the CA has signed, as far as is known."""
        return self._floor

    def now(self) -> float:
        """Return the time by which certificates and lists are judged."""
        wall, floor = self._wall(), self._floor
        behind = wall < floor - SLACK_S
        if behind and not self._behind and self._alert is not None:
            self._alert(
                f"this clock is behind what the CA has signed, by {floor - wall:.0f} s at least: "
                "certificates are judged by that time instead; set the clock"
            )
        self._behind = behind
        return max(wall, floor)

    def note(self, signed_at: float) -> None:
        """The CA signed something then."""
        if self._floor < signed_at <= self._wall():
            self._floor = signed_at
            if self._remember is not None:
                self._remember(signed_at)

    def note_lists(self, trust: Trust) -> None:
        """The CAs signed these revocation lists."""
        for one in trust.lists().values():
            if one is not None:
                self.note(one.signed_at)
