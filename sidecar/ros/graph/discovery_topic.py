"""Reads what the ROS processes of the domain announce about their nodes (rmw's discovery topic).

Each process keeps its last announcement for later readers (`transient_local`). So a new reader of that topic makes
each live process send it again. DDS's own threads do so within tens of milliseconds, even while the application is
busy. A process that was killed or hangs sends nothing.
"""

from __future__ import annotations

import importlib
import logging
from typing import TYPE_CHECKING, Any

from plr.sidecar.ros.errors import RosBridgeError
from plr.sidecar.ros.graph.graph import PARTICIPANTS_TOPIC
from plr.sidecar.ros.rcl import LatchedTopic, MessageType

if TYPE_CHECKING:
    from collections.abc import Iterator

MAX_HEARD_PROCESSES = 1024
"""Participants that one call can hear; the depth of the topic."""
TAKEN_AT_ONCE = 64
BYTES_AT_ONCE = 1 << 16
"""Some milliseconds of many small nodes; the last message taken may exceed it."""

log = logging.getLogger(__name__)


class DiscoveryTopic:
    """A reader for one call at a time. All methods belong to the ROS thread."""

    def __init__(self, node: Any) -> None:
        self._node = node
        self._type: MessageType | None = None
        self._topic: LatchedTopic | None = None
        self.usable = True
        """False where rmw has no such topic."""

    @property
    def is_open(self) -> bool:
        """Whether a call is under way."""
        return self._topic is not None

    def open(self) -> bool:
        """Call all processes; return False if that is impossible."""
        if not self.usable:
            return False
        try:
            if self._type is None:
                # Every DDS rmw needs this package; other rmw implementations work without it.
                module = importlib.import_module("rmw_dds_common.msg")
                self._type = MessageType(module.ParticipantEntitiesInfo)
            self._topic = LatchedTopic(self._node.handle.pointer, PARTICIPANTS_TOPIC, self._type, MAX_HEARD_PROCESSES)
        except (ImportError, AttributeError, RosBridgeError) as error:
            self.usable = False
            log.error(
                "the ROS processes of this domain cannot be asked for their nodes or whether they live: %s", error
            )
            return False
        return True

    def take(self) -> Iterator[bytes]:
        """Yield the answers that have arrived, a limited number at a time."""
        taken_bytes = 0
        for _ in range(TAKEN_AT_ONCE):
            info = None if self._topic is None or taken_bytes >= BYTES_AT_ONCE else self._topic.take()
            if info is None:
                return
            taken_bytes += len(info)
            yield info

    def close(self) -> None:
        """End the call."""
        if self._topic is not None:
            self._topic.close()
            self._topic = None
