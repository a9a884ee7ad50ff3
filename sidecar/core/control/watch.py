"""Watches the connection that carries the control stream, and decides when to leave it for another way. Sans-IO.

A connection is left when what was sent over it stays unacknowledged while another interface may lead there; sooner when
the data plane, whose paths are probed all the time, hears nobody over this interface either but does over another.
Whatever the data plane says, a connection that is acknowledged stays: some networks let only TCP through. With a single
interface nothing is gained by leaving: TCP and gRPC give up in their own time.

It is also left when its interface is gone, and when a cheaper one is well again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from plr.sidecar.core.control.ways import Life

if TYPE_CHECKING:
    from plr.protos.model.ids import InterfaceName
    from plr.sidecar.core.control.ways import ControlWays, Way

SILENT_S = 1.0
"""Time without acknowledgement to leave after, while the data plane hears somebody over another interface."""
SILENT_WITHOUT_NEWS_S = 3.0
"""The same while nothing is known about the other interfaces: they may lead nowhere, and a stall of a cellular link
costs less."""
CONFIRMED_S = 0.25
"""The same while the data plane hears nobody over this interface either."""
ROUND_TRIPS = 3.0
"""The same in worst-case round trips of the connection: none of these times is shorter."""
DOUBT_S = 0.15
"""Time without acknowledgement after which the data plane is asked to probe now, however busy its paths are."""
LOOK_S = 0.25
"""Interval of asking the kernel while something is unacknowledged."""
KEEPALIVE_S = 1
"""Time (s) after which an idle connection is asked for an acknowledgement, and interval of asking: the least that Linux
allows. Kernels do it, so that it costs neither end a turn of Python."""
LIVED_S = 60.0
"""Lifetime of a connection that proves its interface."""

SILENT, GONE, CHEAPER = LEAVE_CAUSES = ("silent", "gone", "cheaper")


@dataclass(frozen=True, slots=True)
class Seen:
    """State of the connection, from the kernel."""

    unacked: bool
    """Whether something sent, if only the kernel's keepalive, is not acknowledged yet."""
    quiet_s: float
    """Time since the last acknowledgement or data."""
    rtt_s: float
    """The longest round trip to be expected."""


@dataclass(frozen=True, slots=True)
class Leave:
    """The decision to leave the connection."""

    cause: str
    """SILENT, GONE or CHEAPER."""
    reason: str
    """The cause in words."""
    to: tuple[Way, ...] = ()
    """The only ways to leave for; empty: any."""


class ControlWatch:
    """Watches one connection from its first byte on. `over` is the interface that it takes, if known."""

    def __init__(self, ways: ControlWays, way: Way, over: InterfaceName | None, now: float) -> None:
        self._ways = ways
        self._way = way
        self._over = over
        self._began = now
        self._heard_at = now
        self._waiting_since: float | None = None
        self._rtt_s = 0.0
        self._look_at = now
        self._doubted_at = now

    @property
    def over(self) -> InterfaceName | None:
        """Return the interface that it takes."""
        return self._over

    def sent(self, now: float) -> None:
        """Note that something was sent that needs an acknowledgement."""
        if self._waiting_since is None:
            self._waiting_since = now
            self._look_at = now + DOUBT_S

    def saw(self, seen: Seen, now: float) -> None:
        """Take the kernel's answer."""
        heard_at = now - seen.quiet_s
        self._rtt_s = seen.rtt_s
        self._look_at = now + LOOK_S
        if heard_at > self._heard_at:
            self._heard_at = heard_at
        if not seen.unacked:
            self._waiting_since = None
        elif self._waiting_since is None:
            self._waiting_since = min(now, self._heard_at + KEEPALIVE_S)
        else:
            self._waiting_since = max(self._waiting_since, self._heard_at)
        if self._over is not None and now >= self._began + LIVED_S:
            self._ways.held_well(self._over)

    def take_doubt(self, now: float) -> InterfaceName | None:
        """Return the interface whose paths have to be probed now, once for each silence."""
        if self._waiting_since is None or self._doubted_at >= self._waiting_since:
            return None
        if now < self._waiting_since + max(DOUBT_S, self._rtt_s) or self._ways.another(self._over, now) is None:
            return None
        self._doubted_at = now
        return self._over

    def judge(self, now: float) -> Leave | None:
        """Return the decision to leave it now, or None; call `saw` first."""
        over = self._over
        if over is not None and not self._ways.has(over):
            return Leave(GONE, f"{over} no longer carries anything")
        limit_s = self._limit_s(now)
        if limit_s is not None and self._waiting_since is not None and now >= self._waiting_since + limit_s:
            return Leave(SILENT, f"nothing arrives over {over or 'its interface'}")
        better = self._ways.better(over, now)
        if better and self._waiting_since is None:
            return Leave(CHEAPER, f"{better[0].interface} works, and costs less than {over}", tuple(better))
        return None

    def _limit_s(self, now: float) -> float | None:
        """Return how long (s) something may be unacknowledged; None: as long as TCP allows."""
        another = self._ways.another(self._over, now)
        if another is None:
            return None
        if self._ways.silent_since(self._over) is not None:
            shortest = CONFIRMED_S
        else:
            shortest = SILENT_S if another is Life.LIVING else SILENT_WITHOUT_NEWS_S
        return max(shortest, ROUND_TRIPS * self._rtt_s)

    def next_timer(self, now: float) -> float | None:
        """Return when to ask the kernel and to `judge`, unless something is sent or the network changes."""
        times = [self._ways.next_better(self._over, now)]
        if self._waiting_since is not None:
            times.append(self._look_at)
        elif self._ways.another(self._over, now) is not None:
            times.append(max(now + DOUBT_S, self._heard_at + KEEPALIVE_S + DOUBT_S))
        return min((at for at in times if at is not None), default=None)
