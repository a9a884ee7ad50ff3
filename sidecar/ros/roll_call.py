"""Asking the ROS processes of the domain whether they live, where their process ids tell nothing.

Each process keeps what it last said of its nodes for those that come later (rmw's discovery topic, `transient_local`).
So a new reader of that topic makes each process that lives send it again: DDS's own threads do so, within tens of
milliseconds, also while the application is busy. A process that was killed, or stands still, sends nothing.
"""

from __future__ import annotations

import importlib
import logging
import math
from typing import TYPE_CHECKING, Any

from sidecar.ros.dds_id import PARTICIPANT_BYTES, participant_of
from sidecar.ros.errors import RosBridgeError
from sidecar.ros.graph import PARTICIPANTS_TOPIC
from sidecar.ros.rcl import LatchedTopic, MessageType

if TYPE_CHECKING:
    from collections.abc import Iterable

CALL_S = 0.7
"""How long a call waits for those that it is about. They take 20 ms on a machine with five processes for each core."""
CALL_EVERY_S = 1.0
"""From one call to the next, if the one before was answered; otherwise at once."""
CALLS_MISSED = 2
"""Who answers none of so many calls in a row is taken for dead until it answers one."""
POLL_S = 0.02
MAX_HEARD = 1024
"""Participants that one call hears; the topic's depth."""
TAKEN_AT_ONCE = 64
_CDR_HEADER_BYTES = 4

log = logging.getLogger(__name__)


class RollCall:
    """One call at a time. All methods belong to the ROS thread."""

    def __init__(self, node: Any) -> None:
        self._node = node
        self._type: MessageType | None = None
        self._topic: LatchedTopic | None = None
        self._asked: set[bytes] = set()
        """Participants of the present call that have not answered."""
        self._ends_at = 0.0
        self._next_at = 0.0
        self._missed: dict[bytes, int] = {}
        """Calls in a row that a participant did not answer."""
        self._heard_at: dict[bytes, float] = {}
        """When a participant answered last."""
        self._usable = True

    def is_silent(self, endpoint: bytes) -> bool:
        """Whether its participant answered none of the last calls."""
        return self._missed.get(participant_of(endpoint), 0) >= CALLS_MISSED

    def has_heard(self, endpoint: bytes, since: float) -> bool:
        """Whether its participant answered a call since then, or can not be asked at all."""
        return not self._usable or self._heard_at.get(participant_of(endpoint), -math.inf) >= since

    @property
    def under_way(self) -> bool:
        """Whether somebody was asked, and `turn` is wanted in POLL_S."""
        return self._topic is not None

    def turn(self, endpoints: Iterable[bytes], now: float) -> bool:
        """Ask those behind `endpoints`, if it is time, and hear who answers; True when `is_silent` changed."""
        if self._topic is None:
            return self._call({participant_of(endpoint) for endpoint in endpoints}, now)
        changed = self._hear(self._topic, now)
        if self._asked and now < self._ends_at:
            return changed
        for participant in self._asked:
            self._missed[participant] = self._missed.get(participant, 0) + 1
            changed |= self._missed[participant] == CALLS_MISSED
        in_doubt = any(self._missed[participant] < CALLS_MISSED for participant in self._asked)
        self._next_at = now if in_doubt else now + CALL_EVERY_S
        self._end()
        return changed

    def keep(self, endpoints: Iterable[bytes]) -> None:
        """Forget all others: the graph shows them no more."""
        wanted = {participant_of(endpoint) for endpoint in endpoints}
        self._missed = {participant: missed for participant, missed in self._missed.items() if participant in wanted}
        self._heard_at = {participant: at for participant, at in self._heard_at.items() if participant in wanted}

    def close(self) -> None:
        """Ask nobody any more."""
        self._end()

    def _call(self, participants: set[bytes], now: float) -> bool:
        if not participants or now < self._next_at or not self._usable:
            return False
        try:
            if self._type is None:
                # Without it no rmw of DDS works, but that of another kind does.
                module = importlib.import_module("rmw_dds_common.msg")
                self._type = MessageType(module.ParticipantEntitiesInfo)
            self._topic = LatchedTopic(self._node.handle.pointer, PARTICIPANTS_TOPIC, self._type, MAX_HEARD)
        except (ImportError, AttributeError, RosBridgeError) as error:
            self._usable = False
            log.error("servers in containers can not be asked whether they live: %s", error)
            return False
        self._asked = participants
        self._ends_at = now + CALL_S
        return False

    def _hear(self, topic: LatchedTopic, now: float) -> bool:
        changed = False
        for _ in range(TAKEN_AT_ONCE):
            said = topic.take()
            if said is None:
                break
            # The message begins with the participant's id.
            participant = said[_CDR_HEADER_BYTES : _CDR_HEADER_BYTES + PARTICIPANT_BYTES]
            if participant in self._asked:
                self._asked.remove(participant)
                self._heard_at[participant] = now
            changed |= self._missed.pop(participant, 0) >= CALLS_MISSED
        return changed

    def _end(self) -> None:
        if self._topic is not None:
            self._topic.close()
            self._topic = None
        self._asked = set()
