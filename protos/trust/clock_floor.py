"""Keeps a floor below which this host's clock is not believed, so that setting it back revives nothing expired.

The floor is the newest time that the fleet's CA is known to have signed: when a revocation list or a certificate was
made. A time counts only if it is no later than the clock when it is seen. So a clock that jumps to next year and back
does no lasting harm, nor does a CA whose own clock is ahead. No peer can raise the floor by what it says.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.protos.trust.identity import Trust

SLACK_S = 300.0
"""A clock behind by no more than this is only corrected slightly; `plr ca` backdates certificates by as much."""


class ClockFloor:
    """The clock with its floor, in seconds since 1970. Any thread may use it."""

    def __init__(
        self,
        wall: Callable[[], float],
        floor: float = 0.0,
        remember: Callable[[float], None] | None = None,
        alert: Callable[[str], None] | None = None,
    ) -> None:
        """Take the host's clock as `wall`, and the `floor` that an earlier run left.

        `remember` is called with each new floor, `alert` once with a text when the clock falls behind it.
        """
        self._wall = wall
        self._floor = floor
        self._remember = remember
        self._alert = alert
        self._behind = False

    @property
    def floor(self) -> float:
        """The newest time that the CA is known to have signed."""
        return self._floor

    def now(self) -> float:
        """Return the time by which certificates and lists are judged."""
        wall, floor = self._wall(), self._floor
        behind = wall < floor - SLACK_S
        if behind and not self._behind and self._alert is not None:
            self._alert(
                f"this clock is at least {floor - wall:.0f} s behind the time at which the CA last signed: "
                "certificates are checked against that time instead; set the clock"
            )
        self._behind = behind
        return max(wall, floor)

    def note(self, signed_at: float) -> None:
        """Note that the CA signed something at `signed_at`."""
        if self._floor < signed_at <= self._wall():
            self._floor = signed_at
            if self._remember is not None:
                self._remember(signed_at)

    def note_lists(self, trust: Trust) -> None:
        """Note when the CAs signed these revocation lists."""
        for one in trust.lists().values():
            if one is not None:
                self.note(one.signed_at)
