"""A message on its way out, shared by the links that carry its fragments."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sidecar.core.frame import BASE_SYMBOL_BYTES, FRAGMENT_OVERHEAD_BYTES, symbol_count
from sidecar.core.priority import Priority

if TYPE_CHECKING:
    from protos.model import NodeName
    from sidecar.core.events import RequestId
    from sidecar.core.path_id import PathId


class OutboundMessage:
    """The bytes of one message and which symbols have arrived.

    Links on several threads share it without a lock: `acked` bytes and `over` only ever go from 0 to 1, and a link
    that reads an old value merely sends a symbol that is no longer needed.
    """

    __slots__ = (
        "acked",
        "answers",
        "count",
        "data",
        "deadline",
        "expires",
        "interfaces",
        "number",
        "over",
        "path",
        "priority",
        "successor",
        "symbol",
    )

    def __init__(
        self,
        number: int,
        path: PathId,
        data: bytes | memoryview,
        *,
        priority: Priority = Priority.NORMAL,
        deadline: float,
        expires: float,
        symbol: int = BASE_SYMBOL_BYTES,
        answers: RequestId | None = None,
    ) -> None:
        self.number = number
        self.path = path
        """Where it was sent first."""
        self.interfaces = {path.interface}
        """Those it was sent over; the engine's, links do not look at this."""
        self.data = memoryview(data)
        self.priority = priority
        self.deadline = deadline
        self.expires = expires
        self.symbol = symbol
        self.count = symbol_count(len(data), symbol)
        self.acked = bytearray(self.count)
        self.answers = answers
        """The request that it answers; the engine's, links do not look at this."""
        self.over = False
        """Delivered, called off, expired or cut anew: nothing of it needs to travel any more."""
        self.successor: OutboundMessage | None = None
        """The same bytes, cut anew into smaller symbols."""

    @property
    def peer(self) -> NodeName:
        """Whom it is for."""
        return self.path.peer

    @property
    def newest(self) -> OutboundMessage:
        """What the bytes travel as by now: this message, or what it was cut into."""
        message = self
        while message.successor is not None:
            message = message.successor
        return message

    @property
    def datagram_bytes(self) -> int:
        """Length of its longest datagram, with the room for the tag."""
        return min(len(self.data), self.symbol) + FRAGMENT_OVERHEAD_BYTES

    def cut_anew(self, number: int, path: PathId, symbol: int) -> OutboundMessage:
        """Return the same bytes as another message, for paths that carry no more than `symbol` bytes at once.

        Its symbols do not complete those of this one at the receiver.
        """
        self.successor = OutboundMessage(
            number,
            path,
            self.data,
            priority=self.priority,
            deadline=self.deadline,
            expires=self.expires,
            symbol=symbol,
            answers=self.answers,
        )
        return self.successor

    def missing(self) -> tuple[int, ...]:
        """The symbols that still have to travel."""
        return tuple(index for index in range(self.count) if self.needs(index))

    def needs(self, index: int) -> bool:
        """Whether this symbol still has to travel."""
        return not self.over and not self.acked[index]

    def symbol_data(self, index: int) -> memoryview:
        """Return one symbol, as a view."""
        start = index * self.symbol
        return self.data[start : start + self.symbol]
