"""Messages that came with enough repair symbols, and are still to be computed: a line for each peer.

The driver computes them on a thread of its own, a slice at a time, and asks for the next after each (`net/decoder.py`).
The peers have their slices in turn, so a peer whose messages take long to compute delays those of others by one slice
each time, however many it sends.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from sidecar.core.base.fair_share import Shares

if TYPE_CHECKING:
    from collections.abc import Iterator

    from protos.model.ids import NodeName, SessionId
    from sidecar.core.base.values import PathId
    from sidecar.core.message.partial import Partial

MAX_BYTES = 128 * 1024 * 1024
"""What messages in line hold, repair symbols included. One peer may hold half: two of the largest that came as repair
symbols alone."""
MAX_MESSAGES = 16_384
"""Messages in line; one peer may have half of them, as many as requests may be in flight to it."""


@dataclass(slots=True, eq=False)
class Decoding:
    """A message to compute from its symbols: work for whoever drives the engine, while nothing is locked."""

    path: PathId
    session: SessionId
    partial: Partial
    _slices: Iterator[None] = field(init=False)

    def __post_init__(self) -> None:
        self._slices = self.partial.decode()

    def run_slice(self) -> bool:
        """Compute a slice, in some milliseconds at most; returns whether that was the last."""
        return next(self._slices, self) is self


class DecodingLine:
    """What is to be decoded, of all peers."""

    __slots__ = ("_bytes", "_messages", "_of")

    def __init__(self) -> None:
        self._bytes = Shares(MAX_BYTES)
        self._messages = Shares(MAX_MESSAGES)
        self._of: OrderedDict[NodeName, deque[Decoding]] = OrderedDict()
        """Oldest first; the peer whose turn is longest ago first."""

    def __len__(self) -> int:
        """Messages in line."""
        return self._messages.used

    def fits(self, peer: NodeName, partial: Partial) -> bool:
        """Whether this message may stand in line."""
        return self._messages.fits(peer) and self._bytes.fits(peer, partial.held_bytes)

    def add(self, decoding: Decoding) -> None:
        """It stands in line from now on; asking `fits` before is the caller's."""
        peer = decoding.path.peer
        self._messages.take(peer)
        self._bytes.take(peer, decoding.partial.held_bytes)
        self._of.setdefault(peer, deque()).append(decoding)

    def next(self) -> Decoding | None:
        """Return the one whose slice is next. It stays at the head of its peer's line until it is `done`."""
        peer = next(iter(self._of), None)
        if peer is None:
            return None
        self._of.move_to_end(peer)
        return self._of[peer][0]

    def done(self, decoding: Decoding) -> bool:
        """It is computed, or never will be; returns whether it was the head of its peer's line still."""
        peer = decoding.path.peer
        line = self._of.get(peer)
        if line is None or line[0] is not decoding:
            return False
        line.popleft()
        self._give_back(decoding)
        if not line:
            del self._of[peer]
        return True

    def forget_peer(self, peer: NodeName) -> int:
        """The peer's session is over; returns how many messages go with it."""
        line = self._of.pop(peer, ())
        for decoding in line:
            self._give_back(decoding)
        return len(line)

    def _give_back(self, decoding: Decoding) -> None:
        peer = decoding.path.peer
        self._messages.give_back(peer)
        self._bytes.give_back(peer, decoding.partial.held_bytes)
