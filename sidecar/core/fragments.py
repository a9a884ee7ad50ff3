"""Reassembly of messages from symbols that may come over any path of a peer; capped in bytes, count and age."""

from __future__ import annotations

import enum
from collections import OrderedDict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from sidecar.core.frame import symbol_count

if TYPE_CHECKING:
    from collections import Counter

    from protos.model import NodeName
    from sidecar.core.frame import Fragment

MAX_PEER_BYTES = 64 * 1024 * 1024
"""Announced bytes of one peer's unfinished messages: almost four of the largest. A sender keeps below it (`outbox.py`),
since what is evicted here was acknowledged and does not come again."""
MAX_PEER_MESSAGES = 8192
"""Unfinished messages of one peer: as many as requests may be in flight to it."""
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
    total: int
    symbol: int
    count: int
    touched_at: float
    parts: dict[int, bytes] = field(default_factory=dict)
    """Symbols by index: memory is spent on what came, not on what was announced."""


class Reassembler:
    """Unfinished messages of one peer's session."""

    __slots__ = ("_bytes", "_dropped", "_finished", "_partials", "peer")

    def __init__(self, peer: NodeName, dropped: Counter[str]) -> None:
        self.peer = peer
        self._partials: OrderedDict[int, _Partial] = OrderedDict()
        """The one that waits longest for news first."""
        self._finished: OrderedDict[int, None] = OrderedDict()
        self._bytes = 0
        self._dropped = dropped

    @property
    def held_bytes(self) -> int:
        """Bytes that the unfinished messages claim."""
        return self._bytes

    def __len__(self) -> int:
        """How many messages are unfinished."""
        return len(self._partials)

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
        elif partial.total != fragment.total or partial.symbol != fragment.symbol:
            self._dropped["fragment_mismatch"] += 1
            return Progress.DROPPED
        parts = partial.parts
        if fragment.symbol_index in parts:
            return Progress.STORED
        # A copy: a view would keep the whole datagram, however little of it the symbol is.
        parts[fragment.symbol_index] = bytes(fragment.data)
        if len(parts) < partial.count:
            partial.touched_at = now
            self._partials.move_to_end(number)
            return Progress.STORED
        del self._partials[number]
        self._bytes -= partial.total
        self._remember(number)
        return memoryview(b"".join(map(parts.__getitem__, range(partial.count))))

    def _open(self, fragment: Fragment, now: float) -> _Partial:
        partials = self._partials
        while partials and (len(partials) >= MAX_PEER_MESSAGES or self._bytes + fragment.total > MAX_PEER_BYTES):
            self._drop_oldest("reassembly_evicted")
        count = symbol_count(fragment.total, fragment.symbol)
        partial = partials[fragment.message] = _Partial(fragment.total, fragment.symbol, count, now)
        self._bytes += fragment.total
        return partial

    def _drop_oldest(self, reason: str) -> None:
        _, partial = self._partials.popitem(last=False)
        self._bytes -= partial.total
        self._dropped[reason] += 1

    def _remember(self, number: int) -> None:
        self._finished[number] = None
        if len(self._finished) > FINISHED_REMEMBERED:
            self._finished.popitem(last=False)

    def expire(self, now: float) -> None:
        """Drop messages that got nothing new for MAX_AGE_S."""
        while self._partials and next(iter(self._partials.values())).touched_at + MAX_AGE_S <= now:
            self._drop_oldest("reassembly_expired")
