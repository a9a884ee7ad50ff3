"""Servers that take requests and answer none: their sidecar is there, and the ROS node behind it hangs.

A robot says of each copy that it measures whether its server had the whole request and yet gave no answer. One answer,
to whichever robot, ends the row: then the server answers somebody.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING

from protos.histogram import MAX_COUNT

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from protos.model import LatencyReport, NodeName, ServiceName

MAX_ROWS = 8192
"""Pairs of server and service with a row; the one that was reported on longest ago goes."""


class Unanswered:
    """How many requests in a row each server left unanswered, by service."""

    def __init__(self) -> None:
        self._rows: OrderedDict[tuple[NodeName, ServiceName], int] = OrderedDict()
        self.forgotten = 0

    def __len__(self) -> int:
        return len(self._rows)

    def note(self, latencies: Collection[LatencyReport]) -> None:
        """A robot reports what servers' shares of its requests were: lost are those without an answer. What came first
        is not told: an answer counts for all of the report."""
        answered = {(one.server, one.service) for one in latencies if one.processing.answered}
        for pair in answered:
            self._rows.pop(pair, None)
        for one in latencies:
            pair = (one.server, one.service)
            if one.processing.lost and pair not in answered:
                self._rows[pair] = min(self._rows.get(pair, 0) + one.processing.lost, MAX_COUNT)
                self._rows.move_to_end(pair)
                if len(self._rows) > MAX_ROWS:
                    self._rows.popitem(last=False)
                    self.forgotten += 1

    def begin(self, server: NodeName, services: Iterable[ServiceName]) -> None:
        """Nothing is known of what serves these there: it is another process, or none."""
        for service in services:
            self._rows.pop((server, service), None)

    def row(self, server: NodeName, service: ServiceName) -> int:
        """Requests that the server had since its last answer, and has not answered."""
        return self._rows.get((server, service), 0)
