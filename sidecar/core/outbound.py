"""A message on its way out, shared by the links that carry its fragments."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sidecar.core.frame import BASE_SYMBOL_BYTES, symbol_count
from sidecar.core.priority import Priority

if TYPE_CHECKING:
    from protos.model import NodeName
    from sidecar.core.path_id import PathId


class OutboundMessage:
    """The bytes of one message and which symbols have arrived.

    Links on several threads share it without a lock: `acked` bytes and `over` only ever go from 0 to 1, and a link
    that reads an old value merely sends a symbol that is no longer needed.
    """

    __slots__ = (
        "acked",
        "count",
        "data",
        "deadline",
        "expires",
        "interfaces",
        "number",
        "over",
        "path",
        "priority",
        "symbol",
    )

    def __init__(
        self,
        number: int,
        path: PathId,
        data: bytes,
        *,
        priority: Priority = Priority.NORMAL,
        deadline: float,
        expires: float,
        symbol: int = BASE_SYMBOL_BYTES,
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
        self.over = False
        """Delivered, called off or expired: nothing of it needs to travel any more."""

    @property
    def peer(self) -> NodeName:
        """Whom it is for."""
        return self.path.peer

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
