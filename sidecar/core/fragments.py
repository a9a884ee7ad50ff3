"""Reassembly of messages from symbols that may come over any path of a peer; capped in bytes, count and age."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sidecar.core.frame import symbol_count

if TYPE_CHECKING:
    from collections import Counter

    from protos.model import NodeName
    from sidecar.core.frame import Fragment

MAX_PEER_BYTES = 64 * 1024 * 1024
"""Claimed bytes of one peer's unfinished messages: four of the largest."""
MAX_PEER_MESSAGES = 4096
"""Unfinished messages of one peer."""
MAX_AGE_S = 30.0
"""An unfinished message that got nothing new for this long is dropped."""
FINISHED_REMEMBERED = 8192
"""Finished message numbers kept per peer, so that late symbols are recognised."""


class Progress(enum.Enum):
    """What a symbol did."""

    STORED = "stored"
    ALREADY_FINISHED = "already_finished"
    DROPPED = "dropped"


@dataclass(slots=True)
class _Partial:
    buffer: bytearray
    symbol: int
    missing: int
    have: bytearray
    touched_at: float


class Reassembler:
    """Unfinished messages of one peer's session."""

    __slots__ = ("_bytes", "_dropped", "_finished", "_partials", "peer")

    def __init__(self, peer: NodeName, dropped: Counter[str]) -> None:
        self.peer = peer
        self._partials: dict[int, _Partial] = {}
        self._finished: dict[int, None] = {}
        self._bytes = 0
        self._dropped = dropped

    @property
    def held_bytes(self) -> int:
        """Bytes that the unfinished messages claim."""
        return self._bytes

    def add(self, fragment: Fragment, now: float) -> memoryview | Progress:
        """Store a symbol; returns the whole message when it was the last one missing."""
        number = fragment.message
        if number in self._finished:
            return Progress.ALREADY_FINISHED
        partial = self._partials.get(number)
        if partial is None:
            if fragment.total == len(fragment.data):
                self._remember(number)
                return fragment.data
            partial = self._open(fragment, now)
        elif len(partial.buffer) != fragment.total or partial.symbol != fragment.symbol:
            self._dropped["fragment_mismatch"] += 1
            return Progress.DROPPED
        partial.touched_at = now
        index = fragment.symbol_index
        if not partial.have[index]:
            partial.have[index] = 1
            partial.missing -= 1
            start = index * partial.symbol
            # The one copy on the way in: symbols arrive in separate datagrams and ROS wants one buffer.
            partial.buffer[start : start + len(fragment.data)] = fragment.data
            if not partial.missing:
                del self._partials[number]
                self._bytes -= fragment.total
                self._remember(number)
                return memoryview(partial.buffer)
        return Progress.STORED

    def _open(self, fragment: Fragment, now: float) -> _Partial:
        partials = self._partials
        while partials and (len(partials) >= MAX_PEER_MESSAGES or self._bytes + fragment.total > MAX_PEER_BYTES):
            self._drop(next(iter(partials)), "reassembly_evicted")
        count = symbol_count(fragment.total, fragment.symbol)
        partial = _Partial(bytearray(fragment.total), fragment.symbol, count, bytearray(count), now)
        partials[fragment.message] = partial
        self._bytes += fragment.total
        return partial

    def _drop(self, number: int, reason: str) -> None:
        self._bytes -= len(self._partials.pop(number).buffer)
        self._dropped[reason] += 1

    def _remember(self, number: int) -> None:
        self._finished[number] = None
        if len(self._finished) > FINISHED_REMEMBERED:
            del self._finished[next(iter(self._finished))]

    def expire(self, now: float) -> None:
        """Drop messages that got nothing new for MAX_AGE_S."""
        old = [number for number, partial in self._partials.items() if partial.touched_at + MAX_AGE_S <= now]
        for number in old:
            self._drop(number, "reassembly_expired")
