"""Keeps the control frames that one path owes its peer until a datagram takes them along."""

from __future__ import annotations

from plr.sidecar.core.base.timers import NEVER
from plr.sidecar.core.wire.frame import Finished, encode_finished

MAX_PENDING_FRAMES = 256
"""Control frames waiting on one path besides FINISHED; only a dishonest peer makes us owe more."""
MAX_PENDING_FINISHED = 8192
"""FINISHED waiting on one path: as many as an honest peer has undelivered messages to us (`room.py`)."""


class Owed:
    """Encoded control frames, and messages to report FINISHED."""

    __slots__ = ("_finished", "_frames", "by")

    def __init__(self) -> None:
        self._frames: list[bytes] = []
        self._finished: dict[int, None] = {}
        self.by = NEVER
        """When all of it leaves at the latest (s); NEVER if nothing waits."""

    def add(self, encoded: bytes, by: float) -> bool:
        """Keep an encoded frame, which leaves by `by` (s); return False if there is no room."""
        if len(self._frames) >= MAX_PENDING_FRAMES:
            return False
        self._frames.append(encoded)
        self.by = min(self.by, by)
        return True

    def add_finished(self, number: int, by: float) -> bool:
        """Keep FINISHED for the peer's message with this number, as `add` does."""
        if len(self._finished) >= MAX_PENDING_FINISHED and number not in self._finished:
            return False
        self._finished[number] = None
        self.by = min(self.by, by)
        return True

    def withdraw(self, frame_type: int) -> None:
        """Drop the waiting frames of this type."""
        self._frames = [encoded for encoded in self._frames if encoded[0] != frame_type]

    def take(self) -> list[bytes]:
        """Remove and return all frames."""
        taken, self._frames = self._frames, []
        taken += [encode_finished(Finished(number)) for number in self.take_finished()]
        self.by = NEVER
        return taken

    def take_finished(self) -> tuple[int, ...]:
        """Remove and return the messages to report FINISHED."""
        finished = tuple(self._finished)
        self._finished.clear()
        return finished

    def put_back(self, frames: list[bytes], by: float) -> int:
        """Keep frames that were taken but may not leave yet; return how many found no room."""
        self._frames, self.by = frames[:MAX_PENDING_FRAMES], by
        return max(0, len(frames) - MAX_PENDING_FRAMES)
