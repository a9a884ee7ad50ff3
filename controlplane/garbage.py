"""Decides when the event loop collects garbage: new objects often and briefly, all objects only when memory grows.

gRPC and asyncio leave an ended stream, some 20 kB, in cycles of exceptions and frames, and other code may leave more.
A full collection is therefore worth its time when memory has grown by more than the members account for. It holds up
the loop for 0.1 to 0.6 s, depending on the size of the fleet: better late than often.
"""

from __future__ import annotations

import resource
from pathlib import Path

from plr.protos.program import interpreter

SET_ASIDE_EVERY_S = 0.1
"""Interval between brief collections: a fleet of 1,000 creates some thousand objects in it, a millisecond of work."""

MEMBER_BYTES = 160 * 1024
"""Memory that one sidecar may account for."""

ROOM_BYTES, ROOM_SHARE = 128 * 1024 * 1024, 0.25
"""Growth that is worth a full collection: more than this many bytes (6,000 ended streams), and more than this share of
the memory left after the last one. The solver's modules, loaded once, take 50 MB."""

_MEMORY = Path("/proc/self/statm")


class GarbageWatch:
    """Compares the memory that a process holds, in bytes, with that after the last full collection."""

    def __init__(self) -> None:
        self._least: int | None = None
        self._members = 0

    def worth_a_look(self, resident: int, members: int) -> bool:
        """Return whether there may be enough garbage to collect, given the number of registered members."""
        if self._least is None:
            self.looked(resident, members)
        assert self._least is not None
        joined = max(0, members - self._members) * MEMBER_BYTES
        return resident > self._least + joined + max(ROOM_BYTES, ROOM_SHARE * self._least)

    def looked(self, resident: int, members: int) -> None:
        """Note the memory left after a full collection."""
        self._least, self._members = resident, members


class Collector:
    """Collects garbage for one event loop; `now` is the loop's time in seconds."""

    def __init__(self) -> None:
        self._watch = GarbageWatch()
        self._set_aside_at = 0.0

    def set_aside(self, now: float) -> None:
        """Collect new objects if it is time to; may be called at any rate."""
        if now >= self._set_aside_at:
            interpreter.set_aside()
            self._set_aside_at = now + SET_ASIDE_EVERY_S

    def look_if_worth(self, members: int) -> None:
        """Collect everything if memory has grown by more than `members` members explain."""
        if self._watch.worth_a_look(_resident(), members):
            interpreter.look_at_all()
            self._watch.looked(_resident(), members)


def _resident() -> int:
    return int(_MEMORY.read_text().split()[1]) * resource.getpagesize()
