"""Endpoints whose node rmw does not know, and what their processes say of them when they are asked.

DDS gives up a process that stands still for longer than its lease, and takes it back when it goes on: a paused virtual
machine, a debugger, a starved host. What the process said of its nodes it is not given a second time then (Fast DDS
believes it delivered): rmw shows its endpoints as those of an unknown node until the process says something new. The
same befalls all others in the eyes of a process that stood still itself.

An endpoint is of an unknown node for some milliseconds as well whenever a process starts; so a while is waited first.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from sidecar.ros.cloud.dds_id import participant_of
from sidecar.ros.graph.participant_info import nodes_of, speaker

UNKNOWN_FOR_S = 1.0
"""A process is asked when rmw has not known the node of one of its endpoints for so long; it is also the least time
between two calls, of which each one reaches all processes of the domain."""
MAX_PAUSE_S = 60.0
"""From one call to the next for an endpoint that nobody names, as of a program that is not ROS; doubled up to this."""
MAX_PARTICIPANTS = 128
"""Participants with endpoints of unknown nodes. A domain has 120 on one host: all of them, if it was ours that stood
still."""
MAX_ENDPOINTS = 512
"""Of each."""


@dataclass(slots=True)
class _Participant:
    due_at: float
    pause_s: float = UNKNOWN_FOR_S
    names: dict[bytes, str | None] = field(default_factory=dict)
    """By endpoint; None until it is told."""
    seen: set[bytes] = field(default_factory=set)
    """Of the endpoints, those that the present look met."""


class UnknownNodes:
    """Looks at the graph begin and end; in between `name_of` is asked for each endpoint that rmw has no name for."""

    def __init__(self) -> None:
        self._participants: dict[bytes, _Participant] = {}
        self._due_at: float | None = None
        self._rests_until = 0.0
        self._dropped = 0

    def begin_look(self) -> None:
        """Another look at the graph begins."""
        self._dropped = 0
        for participant in self._participants.values():
            participant.seen.clear()

    def name_of(self, endpoint: bytes, now: float) -> str | None:
        """Return the full name of its node, if it is told by now; note it otherwise, so that it is asked for."""
        participant = self._participants.get(participant_of(endpoint))
        if participant is None:
            if len(self._participants) >= MAX_PARTICIPANTS:
                self._dropped += 1
                return None
            participant = _Participant(now + UNKNOWN_FOR_S)
            self._participants[participant_of(endpoint)] = participant
        if endpoint not in participant.names:
            if len(participant.names) >= MAX_ENDPOINTS:
                self._dropped += 1
                return None
            participant.names[endpoint] = None
        participant.seen.add(endpoint)
        return participant.names[endpoint]

    def end_look(self) -> int:
        """Forget the endpoints that the look did not meet: they are gone, or rmw knows them.

        Return how many it met that there was no room for.
        """
        for key, participant in tuple(self._participants.items()):
            participant.names = {endpoint: participant.names[endpoint] for endpoint in participant.seen}
            if not participant.names:
                del self._participants[key]
        self._plan()
        return self._dropped

    def next_due(self) -> float | None:
        """Return when `take_due` has something to give, or None."""
        return self._due_at

    def take_due(self, now: float) -> frozenset[bytes]:
        """Return the ids of the participants to be asked now, if it is time for any: a call reaches all.

        The next time is later for each of them.
        """
        if self._due_at is None or now < self._due_at:
            return frozenset()
        asked = {key: state for key, state in self._participants.items() if None in state.names.values()}
        for participant in asked.values():
            participant.due_at = now + participant.pause_s
            participant.pause_s = min(2 * participant.pause_s, MAX_PAUSE_S)
        self._rests_until = now + UNKNOWN_FOR_S
        self._plan()
        return frozenset(asked)

    def learn(self, info: bytes) -> frozenset[str]:
        """Take in what a process says of its nodes; return the names that became known by it.

        Raises RosBridgeError: it is no such message.
        """
        participant = self._participants.get(speaker(info))
        if participant is None:
            return frozenset()
        new = set()
        for name, writers in nodes_of(info):
            for endpoint in participant.names.keys() & writers:
                if participant.names[endpoint] != name:
                    participant.names[endpoint] = name
                    new.add(name)
        self._plan()
        return frozenset(new)

    def _plan(self) -> None:
        dues = [state.due_at for state in self._participants.values() if None in state.names.values()]
        self._due_at = max(self._rests_until, min(dues)) if dues else None
