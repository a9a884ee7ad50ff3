"""Holds the bytes of an outgoing message as symbols, shared by the links that carry them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.sidecar.core.base.timers import NEVER
from plr.sidecar.core.base.values import Priority
from plr.sidecar.core.message.sharing import Sharing
from plr.sidecar.core.wire import fec
from plr.sidecar.core.wire.frame import BASE_SYMBOL_BYTES, FRAGMENT_OVERHEAD_BYTES, MIN_SYMBOL_BYTES, symbol_count

if TYPE_CHECKING:
    from plr.sidecar.core.wire.messages import Encoded


class MessageSymbols:
    """The symbols of one message, and which of them have arrived.

    Links on several threads and the engine share it without a lock: `acked` bytes, `begun` and `over` only ever go from
    0 to 1 (except one `acked` byte that `ask_again` clears). A link that reads an old value of these or of
    `expected_at` merely sends a symbol that is no longer needed, or a little later. The engine changes the list of
    siblings. The rest never changes.

    The payload is never copied as a whole: a symbol is a view of it (the first ones hold the head and are joined),
    which goes into its datagram in the link's thread. That is the only copy on the way out.
    """

    __slots__ = (
        "acked",
        "begun",
        "content",
        "count",
        "deadline",
        "expected_at",
        "expires",
        "number",
        "over",
        "priority",
        "repairs",
        "sharing",
        "siblings",
        "symbol",
        "total",
    )

    def __init__(
        self,
        number: int,
        content: Encoded,
        *,
        priority: Priority = Priority.NORMAL,
        deadline: float,
        expires: float,
        symbol: int = BASE_SYMBOL_BYTES,
        repairs: int = 0,
        siblings: list[MessageSymbols] | None = None,
        repeats: float | None = None,
    ) -> None:
        """Cut the message. `repeats`: several paths carry it together, see `Sharing`, and repeat this share of it."""
        self.number = number
        self.content = content._replace(payload=memoryview(content.payload))
        self.total = content.size
        """Bytes of the message."""
        self.priority = priority
        self.deadline = deadline
        self.expires = expires
        self.expected_at = NEVER
        """When its answer is expected, as last said by the path that sends it; NEVER while none does."""
        self.siblings = [] if siblings is None else siblings
        """The messages that carry the same request, this one included, or none: others need not hurry to do what one is
        expected to do. The owner of the list clears it, so that messages do not hold each other in memory."""
        if siblings is not None:
            siblings.append(self)
        self.count = symbol_count(self.total, symbol)
        """Number of source symbols."""
        self.repairs = min(repairs, fec.max_repairs(self.count))
        """Number of repair symbols, which follow the source symbols."""
        # A repair symbol is as long as the longest source symbol: make them equal.
        self.symbol = max(MIN_SYMBOL_BYTES, -(-self.total // self.count)) if repairs else symbol
        self.acked = bytearray(len(self))
        self.sharing = None if repeats is None else Sharing(len(self), int(repeats * len(self)))
        """What the paths that carry it together know of each other; None: each path carries what it is given."""
        self.begun = False
        """Whether some of it may have left."""
        self.over = False
        """Whether it is delivered, called off, expired or cut again: none of it has to travel any more."""

    def __len__(self) -> int:
        """Return the number of source and repair symbols."""
        return self.count + self.repairs

    @property
    def arrived(self) -> int:
        """Number of symbols that arrived, as far as is known."""
        return self.acked.count(1)

    @property
    def held_bytes(self) -> int:
        """Bytes that the message may occupy at the receiver before it is whole."""
        return self.total + self.repairs * self.symbol

    @property
    def datagram_bytes(self) -> int:
        """Length of its longest datagram, with the room for the tag."""
        return min(self.total, self.symbol) + FRAGMENT_OVERHEAD_BYTES

    def missing(self) -> tuple[int, ...]:
        """Return the symbols that did not arrive, as far as is known."""
        return tuple(index for index in range(len(self)) if self.needs(index))

    def needs(self, index: int) -> bool:
        """Return whether this symbol still has to travel."""
        return not self.over and not self.acked[index]

    def ask_again(self) -> None:
        """Let the first symbol travel once more, although it arrived."""
        self.acked[0] = 0

    def stand_down(self) -> bool:
        """Leave the siblings, which must not rely on it; return whether it was one of them."""
        if self not in self.siblings:
            return False
        self.siblings.remove(self)
        return True

    def cut_again(self, number: int, symbol: int) -> MessageSymbols:
        """Return the same bytes in symbols of at most `symbol` bytes, which take the place of this among its siblings.

        They do not complete those of this one at the receiver.
        """
        return MessageSymbols(
            number,
            self.content,
            priority=self.priority,
            deadline=self.deadline,
            expires=self.expires,
            symbol=symbol,
            repairs=-(-self.repairs * symbol_count(self.total, symbol) // self.count),
            siblings=self.siblings if self.stand_down() else None,
            repeats=None if self.sharing is None else self.sharing.repeats / len(self),
        )

    def symbol_data(self, index: int) -> bytes | memoryview:
        """Return one symbol. A repair symbol is computed here, on the caller's thread, each time."""
        self.begun = True
        if index >= self.count:
            return self._repair(index - self.count)
        head, payload = self.content
        start = index * self.symbol
        end = start + self.symbol
        before = len(head)
        if start >= before:
            return payload[start - before : end - before]
        return b"".join((head[start:end], payload[: max(0, end - before)]))

    def _repair(self, repair: int) -> bytes:
        blocks = fec.block_count(self.count)
        indices = range(repair % blocks, self.count, blocks)
        payload, size, before = self.content.payload, self.symbol, len(self.content.head)
        # As `symbol_data` does, but the many in the middle at once: this costs as much as the coding.
        sources: list[bytes | memoryview] = [
            payload[start : start + size]
            for start in range(indices[0] * size - before, self.total - before, blocks * size)
            if start >= 0
        ]
        sources[:0] = [self.symbol_data(index) for index in indices[: len(indices) - len(sources)]]
        if len(sources[-1]) < size:
            sources[-1] = bytes(sources[-1]).ljust(size, b"\0")
        return fec.encode(sources, repair // blocks)
