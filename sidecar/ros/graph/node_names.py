"""Asks the processes of nodes that rmw does not know for the names of these nodes."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

from plr.sidecar.ros.errors import RosBridgeError
from plr.sidecar.ros.graph.discovery_topic import DiscoveryTopic
from plr.sidecar.ros.graph.participant_info import speaker
from plr.sidecar.ros.graph.unknown_nodes import UnknownNodes

if TYPE_CHECKING:
    from plr.sidecar.ros.log_limit import LimitedLog
    from plr.sidecar.ros.stats import BridgeStats

CALL_S = 0.7
"""How long a call waits for the participants it asks."""
POLL_S = 0.02
NAMES_LOGGED = 8

log = logging.getLogger(__name__)


class NodeNames:
    """Makes one call at a time. All methods belong to the ROS thread."""

    def __init__(self, node: Any, stats: BridgeStats, limited_log: LimitedLog) -> None:
        self._unknown = UnknownNodes()
        self._topic = DiscoveryTopic(node)
        self._stats = stats
        self._limited = limited_log
        self._asked: set[bytes] = set()
        """Participants of the current call that have not answered."""
        self._learned: set[str] = set()
        """Names that the current call found."""
        self._hears_at = 0.0
        self._ends_at = 0.0

    def begin_scan(self) -> None:
        """Begin another scan of the graph."""
        self._unknown.begin_scan()

    def name_of(self, endpoint: bytes, now: float) -> str | None:
        """Return the full name of the node of an endpoint that rmw has no name for; if None, it is asked for soon."""
        return self._unknown.name_of(endpoint, now)

    def end_scan(self) -> None:
        """Forget the endpoints that the scan did not see."""
        if dropped := self._unknown.end_scan():
            self._stats.dropped["too_many_unknown_nodes"] += dropped

    def next_due(self) -> float | None:
        """Return when `turn` has something to do, or None."""
        return self._hears_at if self._topic.is_open else self._unknown.next_due()

    def turn(self, now: float) -> bool:
        """Start a call if it is due, or hear its answers; return True when a name became known."""
        due = self.next_due()
        if due is None or now < due:
            return False
        if not self._topic.is_open:
            self._asked = set(self._unknown.take_due(now))
            if self._asked and self._topic.open():
                self._hears_at, self._ends_at = now + POLL_S, now + CALL_S
            return False
        learned = self._hear(now)
        self._hears_at = now + POLL_S
        if not self._asked or now >= self._ends_at:
            self._topic.close()
            self._tell()
        return learned

    def close(self) -> None:
        """End the current call, if any."""
        self._topic.close()

    def _hear(self, now: float) -> bool:
        learned: set[str] = set()
        for info in self._topic.take():
            self._asked.discard(speaker(info))
            try:
                learned |= self._unknown.learn(info)
            except RosBridgeError as error:
                self._stats.dropped["bad_discovery_message"] += 1
                self._limited.log(
                    logging.WARNING,
                    ("discovery", ""),
                    now,
                    "the message of a ROS process of this domain is ignored: %s",
                    error,
                )
        self._learned |= learned
        return bool(learned)

    def _tell(self) -> None:
        if not self._learned:
            return
        names = " ".join(sorted(self._learned)[:NAMES_LOGGED])
        if len(self._learned) > NAMES_LOGGED:
            names += f" and {len(self._learned) - NAMES_LOGGED} more"
        why = "their process, or this one, stood still for longer than DDS's lease"
        log.info("found nodes again whose names ROS had lost (%s): %s", why, names)
        self._learned.clear()
