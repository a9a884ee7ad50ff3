"""Asks the ROS processes of the domain whether they live; a process id shows that one ended, not that it hangs.

`discovery_topic.py` explains how they are asked.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from plr.sidecar.ros.cloud.dds_id import participant_of
from plr.sidecar.ros.graph.discovery_topic import DiscoveryTopic
from plr.sidecar.ros.graph.participant_info import speaker

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

CALL_S = 0.7
"""How long a call waits for the processes it asks. They take 20 ms on a machine with five processes per core."""
CALL_EVERY_S = 1.0
"""Time between calls, if the one before was answered; otherwise the next follows at once."""
CALLS_MISSED = 2
"""A process that answers none of this many calls in a row counts as dead until it answers. A call counts only for
processes that do not wait for a processor: on an overloaded machine all answer late."""
POLL_S = 0.02


class RollCall:
    """Makes one call at a time. All methods belong to the ROS thread."""

    def __init__(self, node: Any, wants_processor: Callable[[bytes], bool]) -> None:
        """Take `wants_processor`: whether a participant's process is known to run, or to wait for a processor."""
        self._topic = DiscoveryTopic(node)
        self._wants_processor = wants_processor
        self._asked: set[bytes] = set()
        """Participants of the current call that have not answered."""
        self._ends_at = 0.0
        self._next_at = 0.0
        self._missed: dict[bytes, int] = {}
        """Calls in a row that a participant did not answer."""
        self._heard_at: dict[bytes, float] = {}
        """When each participant answered last."""

    def is_silent(self, endpoint: bytes) -> bool:
        """Return whether the endpoint's participant answered none of the last calls."""
        return self._missed.get(participant_of(endpoint), 0) >= CALLS_MISSED

    def has_heard(self, endpoint: bytes, since: float) -> bool:
        """Return whether the endpoint's participant answered since `since`, or cannot be asked at all."""
        return not self._topic.usable or self._heard_at.get(participant_of(endpoint), -math.inf) >= since

    def has_ever_heard(self, endpoint: bytes) -> bool:
        """Return whether the endpoint's participant has answered anything since it appeared in the graph."""
        return participant_of(endpoint) in self._heard_at

    def answered(self, endpoint: bytes, now: float) -> bool:
        """Count an answer to a request like one to a call; return True when `is_silent` changed."""
        participant = participant_of(endpoint)
        self._heard_at[participant] = now
        return self._missed.pop(participant, 0) >= CALLS_MISSED

    @property
    def under_way(self) -> bool:
        """Whether a call is under way, so that `turn` is due in POLL_S."""
        return self._topic.is_open

    def turn(self, endpoints: Iterable[bytes], now: float) -> bool:
        """Ask those behind `endpoints` if a call is due, or hear the answers; return True when `is_silent` changed."""
        if not self._topic.is_open:
            return self._call({participant_of(endpoint) for endpoint in endpoints}, now)
        changed = self._hear(now)
        if self._asked and now < self._ends_at:
            return changed
        for participant in self._asked:
            if self._wants_processor(participant):
                continue
            self._missed[participant] = self._missed.get(participant, 0) + 1
            changed |= self._missed[participant] == CALLS_MISSED
        in_doubt = any(self._missed.get(participant, 0) < CALLS_MISSED for participant in self._asked)
        self._next_at = now if in_doubt else now + CALL_EVERY_S
        self._end()
        return changed

    def keep(self, endpoints: Iterable[bytes]) -> None:
        """Forget all others, which are gone from the graph."""
        wanted = {participant_of(endpoint) for endpoint in endpoints}
        self._missed = {participant: missed for participant, missed in self._missed.items() if participant in wanted}
        self._heard_at = {participant: at for participant, at in self._heard_at.items() if participant in wanted}

    def close(self) -> None:
        """End the current call, if any."""
        self._end()

    def _call(self, participants: set[bytes], now: float) -> bool:
        if not participants or now < self._next_at or not self._topic.open():
            return False
        self._asked = participants
        self._ends_at = now + CALL_S
        return False

    def _hear(self, now: float) -> bool:
        changed = False
        for info in self._topic.take():
            participant = speaker(info)
            if participant in self._asked:
                self._asked.remove(participant)
                self._heard_at[participant] = now
            changed |= self._missed.pop(participant, 0) >= CALLS_MISSED
        return changed

    def _end(self) -> None:
        self._topic.close()
        self._asked = set()
