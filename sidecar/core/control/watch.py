"""Watches the connection that carries the control stream: is it to be left for another way? Sans-IO.

It is, when what was sent over it stays unacknowledged while another interface may lead there; sooner when the data
plane, whose paths are probed all the time, hears nobody over this interface either but does over another. Whatever the
data plane says, a connection that is acknowledged stays: some networks let nothing through but TCP. With a single
interface nothing is gained by leaving: TCP and gRPC give up in their own time.

It is also to be left when its interface is gone, and when a cheaper one is well again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from sidecar.core.control.ways import Life

if TYPE_CHECKING:
    from protos.model.ids import InterfaceName
    from sidecar.core.control.ways import ControlWays, Way

SILENT_S = 1.0
"""Unacknowledged for so long, while the data plane hears somebody over another interface."""
SILENT_WITHOUT_NEWS_S = 3.0
"""While of the other interfaces nothing is known: one may lead nowhere, and a stall of a cellular link is cheaper."""
CONFIRMED_S = 0.25
"""While the data plane does not hear anybody over this interface either."""
ROUND_TRIPS = 3.0
"""No silence is shorter than so many of the connection's round trips, at their worst."""
DOUBT_S = 0.15
"""Then the data plane is asked to find out now, whatever its paths have to do."""
LOOK_S = 0.25
"""While something is unacknowledged, the kernel is asked this often."""
KEEPALIVE_S = 1
"""A connection that says nothing is asked for an acknowledgement after so long, the least that Linux knows, and as
often: by kernels, so that it costs neither end a turn of Python."""
LIVED_S = 60.0
"""A connection that lived so long proves its interface."""

SILENT, GONE, CHEAPER = LEAVE_CAUSES = ("silent", "gone", "cheaper")


@dataclass(frozen=True, slots=True)
class Seen:
    """What the kernel says of the connection."""

    unacked: bool
    """Whether something sent, if only by the kernel to ask for it, is not acknowledged yet."""
    quiet_s: float
    """Since the last acknowledgement or data."""
    rtt_s: float
    """The longest round trip to be expected."""


@dataclass(frozen=True, slots=True)
class Leave:
    """The connection is to be left."""

    cause: str
    """SILENT, GONE or CHEAPER."""
    reason: str
    """In words."""
    to: tuple[Way, ...] = ()
    """Only for one of these."""


class ControlWatch:
    """One connection, from its first byte on. `over` is the interface that it takes, as far as it is known."""

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
        """The interface that it takes."""
        return self._over

    def sent(self, now: float) -> None:
        """Something that wants an acknowledgement was sent."""
        if self._waiting_since is None:
            self._waiting_since = now
            self._look_at = now + DOUBT_S

    def saw(self, seen: Seen, now: float) -> None:
        """The kernel was asked."""
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
        """The interface whose paths are to be probed now, once for each silence."""
        if self._waiting_since is None or self._doubted_at >= self._waiting_since:
            return None
        if now < self._waiting_since + max(DOUBT_S, self._rtt_s) or self._ways.another(self._over, now) is None:
            return None
        self._doubted_at = now
        return self._over

    def judge(self, now: float) -> Leave | None:
        """Whether to leave it now; call `saw` first."""
        over = self._over
        if over is not None and not self._ways.has(over):
            return Leave(GONE, f"{over} carries nothing any more")
        limit_s = self._limit_s(now)
        if limit_s is not None and self._waiting_since is not None and now >= self._waiting_since + limit_s:
            return Leave(SILENT, f"nothing comes over {over or 'its interface'}")
        better = self._ways.better(over, now)
        if better and self._waiting_since is None:
            return Leave(CHEAPER, f"{better[0].interface} is well, and costs less than {over}", tuple(better))
        return None

    def _limit_s(self, now: float) -> float | None:
        """How long something may be unacknowledged; None: as long as TCP likes."""
        another = self._ways.another(self._over, now)
        if another is None:
            return None
        if self._ways.silent_since(self._over) is not None:
            shortest = CONFIRMED_S
        else:
            shortest = SILENT_S if another is Life.LIVING else SILENT_WITHOUT_NEWS_S
        return max(shortest, ROUND_TRIPS * self._rtt_s)

    def next_timer(self, now: float) -> float | None:
        """When to ask the kernel and to `judge`, unless something is sent or the network changes."""
        times = [self._ways.next_better(self._over, now)]
        if self._waiting_since is not None:
            times.append(self._look_at)
        elif self._ways.another(self._over, now) is not None:
            times.append(max(now + DOUBT_S, self._heard_at + KEEPALIVE_S + DOUBT_S))
        return min((at for at in times if at is not None), default=None)
