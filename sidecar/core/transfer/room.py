"""Limits what may be under way to one peer: by what it can reassemble, and by the number of messages.

A peer reassembles unfinished messages in MAX_PEER_BYTES (`reassembly.py`), each copy of a payload in its own buffer.
Large and small messages each have a part of it to themselves: neither waits for the other, however many there are. A
message of one datagram is never unfinished, so only its number counts.
"""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING

from plr.sidecar.core.base.fair_share import Shares
from plr.sidecar.core.wire.frame import BASE_SYMBOL_BYTES

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName
    from plr.sidecar.core.base.values import PathId
    from plr.sidecar.core.message.outbound import OutboundMessage

MAX_UNDELIVERED_MESSAGES = 16_384
"""All undelivered messages; one peer may have half of them, as many as requests may be in flight."""
SMALL_BYTES = 256 * 1024
"""The longest message that counts as small: a camera's image does."""
SMALL_ROOM_BYTES = 16 * 1024 * 1024
"""Undelivered small messages to one peer: what 1 Gbit/s carries in 130 ms."""
LARGE_ROOM_BYTES = 48 * 1024 * 1024
"""Undelivered larger messages to one peer: three of 16 MB. With the small ones it is what a peer can reassemble."""


class Lane(enum.IntEnum):
    """Messages that share room, by their size."""

    DATAGRAM = 0
    SMALL = 1
    LARGE = 2

    @classmethod
    def of(cls, size: int) -> Lane:
        """Return the lane of a message of `size` bytes."""
        if size <= BASE_SYMBOL_BYTES:
            return cls.DATAGRAM
        return cls.SMALL if size <= SMALL_BYTES else cls.LARGE


_ROOM_BYTES = {Lane.SMALL: SMALL_ROOM_BYTES, Lane.LARGE: LARGE_ROOM_BYTES}


class Room:
    """Room that each peer's undelivered messages take."""

    __slots__ = ("_held", "_messages", "_over", "held_bytes")

    def __init__(self) -> None:
        self._messages = Shares(MAX_UNDELIVERED_MESSAGES)
        self._held: dict[tuple[NodeName, Lane], int] = {}
        self._over: dict[PathId, int] = {}
        self.held_bytes = 0
        """Bytes of all undelivered messages."""

    def messages_to(self, peer: NodeName) -> int:
        """Return the number of undelivered messages to this peer."""
        return self._messages.held(peer)

    def sent_over(self, path: PathId) -> int:
        """Return the bytes of undelivered messages first sent over this path."""
        return self._over.get(path, 0)

    def fits(self, peer: NodeName, size: int, held: int | None = None) -> bool:
        """Return whether a message of `size` bytes fits, which holds `held` with its repair symbols."""
        if not self._messages.fits(peer):
            return False
        lane = Lane.of(size)
        if lane is Lane.DATAGRAM:
            return True
        return self._held.get((peer, lane), 0) + (size if held is None else held) <= _ROOM_BYTES[lane]

    def take(self, message: OutboundMessage) -> None:
        """Take the room of a message under way; the caller asks `fits` before."""
        self._messages.take(message.path.peer)
        self._add(message, message.symbols.held_bytes)

    def give_back(self, message: OutboundMessage) -> None:
        """Give back the room of a message that is over."""
        self._messages.give_back(message.path.peer)
        self._add(message, -message.symbols.held_bytes)

    def _add(self, message: OutboundMessage, held: int) -> None:
        self.held_bytes += held
        path = message.path
        key = path.peer, Lane.of(message.symbols.total)
        self._held[key] = self._held.get(key, 0) + held
        if not self._held[key]:
            del self._held[key]
        self._over[path] = self._over.get(path, 0) + held
        if not self._over[path]:
            del self._over[path]
