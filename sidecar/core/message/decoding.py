"""Queues messages that still have to be computed from their repair symbols: a line for each peer.

The driver computes them on a separate thread, a slice at a time, and asks for the next after each (`net/decoder.py`).
The peers take turns, so a peer whose messages take long to compute delays those of others by one slice each time,
however many it sends.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from plr.sidecar.core.base.fair_share import Shares

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.protos.model.ids import NodeName, SessionId
    from plr.sidecar.core.base.values import PathId
    from plr.sidecar.core.message.partial import Partial

MAX_DECODING_BYTES = 128 * 1024 * 1024
"""Bytes of the messages in line, repair symbols included. One peer may hold half: two of the largest that came as
repair symbols alone."""
MAX_DECODING_MESSAGES = 16_384
"""Messages in line; one peer may have half of them, as many as requests may be in flight to it."""


@dataclass(slots=True, eq=False)
class Decoding:
    """A message to compute from its symbols, by whoever drives the engine, while nothing is locked."""

    path: PathId
    session: SessionId
    partial: Partial
    _slices: Iterator[None] = field(init=False)

    def __post_init__(self) -> None:
        self._slices = self.partial.decode()

    def run_slice(self) -> bool:
        """Compute a slice, in some milliseconds at most; return whether it was the last."""
        return next(self._slices, self) is self


class DecodingLine:
    """The messages of all peers that wait to be decoded."""

    __slots__ = ("_bytes", "_messages", "_of")

    def __init__(self) -> None:
        self._bytes = Shares(MAX_DECODING_BYTES)
        self._messages = Shares(MAX_DECODING_MESSAGES)
        self._of: OrderedDict[NodeName, deque[Decoding]] = OrderedDict()
        """Each peer's messages, oldest first; the peers by their last turn, longest ago first."""

    def __len__(self) -> int:
        """Return the number of messages in line."""
        return self._messages.used

    def fits(self, peer: NodeName, partial: Partial) -> bool:
        """Return whether this message may join the line."""
        return self._messages.fits(peer) and self._bytes.fits(peer, partial.held_bytes)

    def add(self, decoding: Decoding) -> None:
        """Add a message to the line; the caller asks `fits` before."""
        peer = decoding.path.peer
        self._messages.take(peer)
        self._bytes.take(peer, decoding.partial.held_bytes)
        self._of.setdefault(peer, deque()).append(decoding)

    def next(self) -> Decoding | None:
        """Return the message whose slice is next. It stays at the head of its peer's line until it is `done`."""
        peer = next(iter(self._of), None)
        if peer is None:
            return None
        self._of.move_to_end(peer)
        return self._of[peer][0]

    def done(self, decoding: Decoding) -> bool:
        """Remove a message that is computed, or never will be; return whether it still headed its peer's line."""
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
        """Drop the messages of a peer whose session is over; return how many."""
        line = self._of.pop(peer, ())
        for decoding in line:
            self._give_back(decoding)
        return len(line)

    def _give_back(self, decoding: Decoding) -> None:
        peer = decoding.path.peer
        self._messages.give_back(peer)
        self._bytes.give_back(peer, decoding.partial.held_bytes)
