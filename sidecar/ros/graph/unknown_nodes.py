"""Tracks endpoints whose node rmw does not know, and what their processes answer when asked.

DDS drops a process that hangs for longer than its lease, and takes it back when it resumes: in a paused virtual
machine, under a debugger, on a starved host. But what the process announced about its nodes is not delivered again
(Fast DDS believes it was). So rmw shows its endpoints as those of an unknown node until the process announces something
new. A process that hung itself sees all others like this.

When a process starts, its endpoints also belong to an unknown node for some milliseconds; so nothing is asked at once.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from plr.sidecar.ros.cloud.dds_id import participant_of
from plr.sidecar.ros.graph.participant_info import nodes_of, speaker

UNKNOWN_FOR_S = 1.0
"""How long rmw must not have known the node of an endpoint before its process is asked. Also the least time between two
calls, as each call reaches all processes of the domain."""
MAX_PAUSE_S = 60.0
"""Longest pause between calls for an endpoint that nobody names, such as a non-ROS program's; it doubles up to this."""
MAX_PARTICIPANTS = 128
"""Participants with endpoints of unknown nodes. A domain has up to 120 on one host, and all of them are unknown if it
was our process that hung."""
MAX_ENDPOINTS = 512
"""Endpoints of each participant."""


@dataclass(slots=True)
class _Participant:
    due_at: float
    pause_s: float = UNKNOWN_FOR_S
    names: dict[bytes, str | None] = field(default_factory=dict)
    """Node names by endpoint; None until known."""
    seen: set[bytes] = field(default_factory=set)
    """Endpoints that the current scan saw."""


class UnknownNodes:
    """Endpoints without a name. In each scan of the graph, `name_of` is called for each that rmw has no name for."""

    def __init__(self) -> None:
        self._participants: dict[bytes, _Participant] = {}
        self._due_at: float | None = None
        self._rests_until = 0.0
        self._dropped = 0

    def begin_scan(self) -> None:
        """Begin another scan of the graph."""
        self._dropped = 0
        for participant in self._participants.values():
            participant.seen.clear()

    def name_of(self, endpoint: bytes, now: float) -> str | None:
        """Return the full name of the endpoint's node, if known by now; otherwise note the endpoint to be asked for."""
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

    def end_scan(self) -> int:
        """Forget the endpoints that the scan did not see: they are gone, or rmw knows them.

        Return how many it saw that there was no room for.
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
        """Return the ids of the participants to ask now: if any is due, all, as a call reaches all.

        The next call is scheduled later for each of them.
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
        """Take in what a process announces about its nodes; return the names that became known.

        Raises RosBridgeError if it is no such message.
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
