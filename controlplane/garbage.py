"""When the event loop looks for garbage: what is new often and briefly, everything only when memory says so.

gRPC and asyncio leave an ended stream, some 20 kB, in cycles of exceptions and frames; nobody knows of all that may. So
the memory that grows beyond what the members account for is what makes a full look worth its time. It holds the loop
for 0.1 to 0.6 s, by the size of the fleet: so late is better than often.
"""

from __future__ import annotations

import resource
from pathlib import Path

from protos.program import interpreter

SET_ASIDE_EVERY_S = 0.1
"""A fleet of 1,000 makes some thousand objects in this time, which take a millisecond."""

MEMBER_BYTES = 160 * 1024
"""What a sidecar may take."""

ROOM_BYTES, ROOM_SHARE = 128 * 1024 * 1024, 0.25
"""More than that, and more than that share of what was there after the last full look, is worth the next one: 6,000
ended streams. The solver's modules, which come once, take 50 MB."""

_MEMORY = Path("/proc/self/statm")


class GarbageWatch:
    """Judges how much memory a process holds, in bytes, against that after the last full look."""

    def __init__(self) -> None:
        self._least: int | None = None
        self._members = 0

    def worth_a_look(self, resident: int, members: int) -> bool:
        """Whether there may be enough to find, with so many members registered."""
        if self._least is None:
            self.looked(resident, members)
        assert self._least is not None
        joined = max(0, members - self._members) * MEMBER_BYTES
        return resident > self._least + joined + max(ROOM_BYTES, ROOM_SHARE * self._least)

    def looked(self, resident: int, members: int) -> None:
        """All has been looked at; this is what is left."""
        self._least, self._members = resident, members


class Collector:
    """Collects for one event loop; `now` is its time in seconds."""

    def __init__(self) -> None:
        self._watch = GarbageWatch()
        self._set_aside_at = 0.0

    def set_aside(self, now: float) -> None:
        """Look at what is new, now and then; call it as often as you like."""
        if now >= self._set_aside_at:
            interpreter.set_aside()
            self._set_aside_at = now + SET_ASIDE_EVERY_S

    def look_if_worth(self, members: int) -> None:
        """Look at all if memory has grown by more than so many members explain."""
        if self._watch.worth_a_look(_resident(), members):
            interpreter.look_at_all()
            self._watch.looked(_resident(), members)


def _resident() -> int:
    return int(_MEMORY.read_text().split()[1]) * resource.getpagesize()
