"""Collects what is measured on one path between two reports to the engine."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.sidecar.core.seam.links import PathMeasured

if TYPE_CHECKING:
    from plr.sidecar.core.base.values import PathId
    from plr.sidecar.core.path.congestion.controller import CongestionController
    from plr.sidecar.core.path.recovery import Recovery

MAX_RTT_SAMPLES = 512
"""Round-trip times kept between two reports."""


class PathReport:
    """Round-trip times since the last report, and the counts of then."""

    __slots__ = ("_arrived", "_lost", "_missed", "_rtts", "_sent")

    def __init__(self) -> None:
        self._rtts: list[float] = []
        self._sent = 0
        self._lost = 0
        self._arrived = 0
        self._missed = 0

    def note_rtt(self, rtt_s: float) -> None:
        """Keep a round-trip time for the next report."""
        if len(self._rtts) < MAX_RTT_SAMPLES:
            self._rtts.append(rtt_s)

    def take(self, path: PathId, recovery: Recovery, control: CongestionController) -> PathMeasured | None:
        """Return what was measured since the last call; None if nothing was."""
        sent, lost = recovery.total_sent, recovery.total_lost
        if not self._rtts and sent == self._sent:
            return None
        measured = PathMeasured(
            path,
            recovery.rtt.smoothed,
            tuple(self._rtts),
            sent - self._sent,
            lost - self._lost,
            *self._take_fates(recovery),
            policed=control.take_policed(),
        )
        self._rtts.clear()
        self._sent, self._lost = sent, lost
        return measured

    def _take_fates(self, recovery: Recovery) -> tuple[int, int]:
        """Return how many datagrams arrived and were missing since the last call."""
        arrived, missed = recovery.total_arrived, recovery.reordering.missed
        before_arrived, before_missed = self._arrived, self._missed
        # More may have arrived late than went missing in the meantime: then the next report counts that many fewer.
        self._arrived, self._missed = arrived, max(missed, before_missed)
        return arrived - before_arrived, max(0, missed - before_missed)
