"""Defines what a path asks of its congestion controller, and what it reports to it.

A controller decides how much may be in flight on one path, and when the next burst may leave. It is told what leaves,
arrives and gets lost; it reads no clock and knows no path. Sizes are in bytes, rates in bytes a second, times in
seconds. `choice.py` lists the controllers that there are.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

if TYPE_CHECKING:
    from plr.sidecar.core.path.congestion.rtt import RttEstimator

MAX_WINDOW_BYTES = 16 * 1024 * 1024
"""Most bytes in flight, with any controller: 1 Gbit/s over 134 ms."""


class RateSample(NamedTuple):
    """What one acknowledgement tells of the datagrams that were reported with `on_sent`."""

    acked_bytes: int
    """Bytes that it newly acknowledges."""
    sent_at: float
    """When the newest of those datagrams left (s)."""
    rtt_s: float
    """Round trip of that datagram; 0 if it is not the largest acknowledged, so that nothing was measured."""
    in_flight: int
    """Bytes in flight after it."""


class CongestionController(Protocol):
    """Window and pacing of one path."""

    # -- queries --------------------------------------------------------------------------------------------------

    def budget(self, now: float, in_flight: int) -> int:
        """Return the bytes that may leave now: 0, or at least one datagram. Called when something waits."""
        ...

    def next_release(self, in_flight: int) -> float | None:
        """Return when pacing lets more leave, even if past; None if only an acknowledgement can."""
        ...

    @property
    def window(self) -> float:
        """Bytes that may be in flight, at most MAX_WINDOW_BYTES."""
        ...

    @property
    def pacing_rate(self) -> float | None:
        """Bytes a second; None while the path is unknown. It also says which message can still be in time."""
        ...

    def take_policed(self) -> bool:
        """Return whether a policer was found to limit the path since the last call."""
        ...

    # -- inputs ---------------------------------------------------------------------------------------------------

    def on_sent(self, now: float, size: int, in_flight: int) -> None:
        """Note that these bytes left; `in_flight` includes them."""
        ...

    def ran_dry(self) -> None:
        """Note that nothing waits although more may leave: later deliveries say little of what the path can carry."""
        ...

    def on_acked(self, sample: RateSample, rtt: RttEstimator, now: float) -> None:
        """Learn from an acknowledgement."""
        ...

    def on_lost(self, lost_bytes: int, sent_at: float, in_flight: int, now: float) -> None:
        """Take a loss of these bytes, the newest of them sent at `sent_at`; `in_flight` is what is left."""
        ...

    def on_spurious(self, size: int) -> None:
        """Note that these bytes arrived although they were reported lost."""
        ...

    def on_probe_timeout(self, now: float) -> None:
        """Let two datagrams leave whatever is in flight, since nothing was heard (RFC 9002 section 7.5)."""
        ...

    def on_path_down(self) -> None:
        """Note that the path is dead. What is in flight counts neither as acknowledged nor as lost."""
        ...

    def on_path_up(self, now: float) -> None:
        """Note that the path answers, for the first time or after an outage."""
        ...
