"""How much may be under way to one peer: what it can put together, and how many messages.

A peer puts unfinished messages together in MAX_PEER_BYTES (`reassembly.py`), each copy of a payload in a buffer of its
own. Large messages and small ones have parts of it that are theirs alone: neither waits for the other, however many
there are. A message of one datagram is never unfinished, so only its number counts.
"""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING

from sidecar.core.base.fair_share import Shares
from sidecar.core.wire.frame import BASE_SYMBOL_BYTES

if TYPE_CHECKING:
    from protos.model.ids import NodeName
    from sidecar.core.base.values import PathId
    from sidecar.core.message.outbound import OutboundMessage

MAX_MESSAGES = 16_384
"""All undelivered messages: one peer may have half of them, as many as requests may be in flight."""
SMALL_BYTES = 256 * 1024
"""The longest message that counts as small: a camera's image does."""
SMALL_ROOM_BYTES = 16 * 1024 * 1024
"""Undelivered small messages to one peer: what 1 Gbit/s carries in 130 ms."""
LARGE_ROOM_BYTES = 48 * 1024 * 1024
"""Undelivered larger messages to one peer: three of 16 MB. With the small ones: what it can put together."""


class Lane(enum.IntEnum):
    """Messages that share room, by their size."""

    DATAGRAM = 0
    SMALL = 1
    LARGE = 2

    @classmethod
    def of(cls, size: int) -> Lane:
        """Where a message of `size` bytes belongs."""
        if size <= BASE_SYMBOL_BYTES:
            return cls.DATAGRAM
        return cls.SMALL if size <= SMALL_BYTES else cls.LARGE


_ROOM_BYTES = {Lane.SMALL: SMALL_ROOM_BYTES, Lane.LARGE: LARGE_ROOM_BYTES}


class Room:
    """What each peer's undelivered messages hold."""

    __slots__ = ("_held", "_messages", "_over", "held_bytes")

    def __init__(self) -> None:
        self._messages = Shares(MAX_MESSAGES)
        self._held: dict[tuple[NodeName, Lane], int] = {}
        self._over: dict[PathId, int] = {}
        self.held_bytes = 0
        """Bytes of all undelivered messages."""

    def messages_to(self, peer: NodeName) -> int:
        """How many messages to this peer are undelivered."""
        return self._messages.held(peer)

    def sent_over(self, path: PathId) -> int:
        """Bytes of the undelivered messages that were first sent over this path."""
        return self._over.get(path, 0)

    def fits(self, peer: NodeName, size: int, held: int | None = None) -> bool:
        """Whether there is room for a message of `size` bytes, which holds `held` with its repair symbols."""
        if not self._messages.fits(peer):
            return False
        lane = Lane.of(size)
        if lane is Lane.DATAGRAM:
            return True
        return self._held.get((peer, lane), 0) + (size if held is None else held) <= _ROOM_BYTES[lane]

    def take(self, message: OutboundMessage) -> None:
        """The message is under way; asking `fits` before is the caller's."""
        self._messages.take(message.peer)
        self._add(message, message.held_bytes)

    def give_back(self, message: OutboundMessage) -> None:
        """The message that took it is over."""
        self._messages.give_back(message.peer)
        self._add(message, -message.held_bytes)

    def _add(self, message: OutboundMessage, held: int) -> None:
        self.held_bytes += held
        key = message.peer, Lane.of(message.total)
        self._held[key] = self._held.get(key, 0) + held
        if not self._held[key]:
            del self._held[key]
        path = message.path
        self._over[path] = self._over.get(path, 0) + held
        if not self._over[path]:
            del self._over[path]
