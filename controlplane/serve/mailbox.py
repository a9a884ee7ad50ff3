"""Holds what waits to be written to one stream: bounded, since a newer resource replaces an unsent older one.

A change of the peers is merged into an unsent set or change that it builds on.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from plr.protos.model.mapping import MappingSet
from plr.protos.model.members import PeerSet
from plr.protos.model.peer_changes import put_together
from plr.protos.model.stream import Welcome

if TYPE_CHECKING:
    from plr.controlplane.core.publish.messages import CloseReason
    from plr.protos.model.stream import ControlMessage

_ORDER = (Welcome, PeerSet, MappingSet)
"""Order of writing: a mapping follows the peers that it names."""


class Mailbox:
    """At most one message of each type, and finally the reason to close; for one event loop."""

    def __init__(self) -> None:
        self._waiting: dict[type[ControlMessage], ControlMessage] = {}
        self._changed = asyncio.Event()
        self._close_reason: CloseReason | None = None
        self.superseded = 0
        """Messages replaced by a newer one before they were written: the stream is slower than the changes."""

    def put(self, message: ControlMessage) -> None:
        """Queue this message, in place of an unsent older one of its type."""
        unsent = self._waiting.get(type(message))
        self.superseded += unsent is not None
        if isinstance(message, PeerSet) and isinstance(unsent, PeerSet):
            message = put_together(unsent, message)
        self._waiting[type(message)] = message
        self._changed.set()

    def close(self, reason: CloseReason) -> None:
        """End the stream; unsent messages no longer matter."""
        self._close_reason = reason
        self._changed.set()

    def take(self) -> ControlMessage | CloseReason | None:
        """Return the next message to write, or the reason to close; None while there is nothing to do."""
        if self._close_reason is not None:
            return self._close_reason
        for kind in _ORDER:
            message = self._waiting.pop(kind, None)
            if message is not None:
                return message
        return None

    async def get(self) -> ControlMessage | CloseReason:
        """Wait for the next message to write, or the reason to close."""
        while (next_one := self.take()) is None:
            self._changed.clear()
            await self._changed.wait()
        return next_one
