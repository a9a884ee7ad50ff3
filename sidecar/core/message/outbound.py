"""Holds an outgoing message, shared by the links that carry its fragments."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.sidecar.core.base.timers import NEVER
from plr.sidecar.core.base.values import Priority
from plr.sidecar.core.wire import fec
from plr.sidecar.core.wire.frame import BASE_SYMBOL_BYTES, FRAGMENT_OVERHEAD_BYTES, MIN_SYMBOL_BYTES, symbol_count

if TYPE_CHECKING:
    from collections.abc import Iterable

    from plr.protos.model.ids import NodeName
    from plr.sidecar.core.base.values import PathId, RequestId
    from plr.sidecar.core.wire.messages import Encoded


class OutboundMessage:
    """The bytes of one message, and which symbols have arrived.

    Links on several threads share it without a lock: `acked` bytes, `begun` and `over` only ever go from 0 to 1 (except
    one `acked` byte that `Outbox.ask_again` clears). A link that reads an old value of these or of `expected_at` merely
    sends a symbol that is no longer needed, or a little later.

    The payload is never copied as a whole: a symbol is a view of it (the first ones hold the head and are joined),
    which goes into its datagram in the link's thread. That is the only copy on the way out.
    """

    __slots__ = (
        "_copies",
        "_lost",
        "_lost_repairs",
        "acked",
        "answers",
        "begun",
        "content",
        "copy_of",
        "count",
        "deadline",
        "expected_at",
        "expires",
        "generation",
        "interfaces",
        "number",
        "over",
        "path",
        "priority",
        "repairs",
        "siblings",
        "successor",
        "symbol",
        "total",
        "unreported",
    )

    def __init__(
        self,
        number: int,
        path: PathId,
        content: Encoded,
        *,
        priority: Priority = Priority.NORMAL,
        deadline: float,
        expires: float,
        symbol: int = BASE_SYMBOL_BYTES,
        answers: RequestId | None = None,
        copy_of: RequestId | None = None,
        repairs: int = 0,
        siblings: list[OutboundMessage] | None = None,
    ) -> None:
        self.number = number
        self.path = path
        """The path it was first sent over."""
        self.interfaces = {path.interface}
        """The interfaces it was sent over; for the engine only."""
        self.content = content._replace(payload=memoryview(content.payload))
        self.total = content.size
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
        self.acked = bytearray(self.symbols)
        self.answers = answers
        """The request that it answers; for the engine only."""
        self.copy_of = copy_of
        """The request that it is a copy of; for the engine only."""
        self.begun = False
        """Whether some of it may have left."""
        self.unreported = False
        """Whether the peer, when the engine last looked, had enough of it but had not reported it FINISHED."""
        self.over = False
        """Whether it is delivered, called off, expired or cut again: none of it has to travel any more."""
        self.successor: OutboundMessage | None = None
        """The same bytes, cut again into smaller symbols."""
        self.generation = 0
        """Number of earlier messages with the same bytes."""
        self._copies: dict[int, int] = {}
        """For each symbol with several datagrams in flight, how many more than one."""
        self._lost: set[int] = set()
        self._lost_repairs: set[int] = set()

    @property
    def peer(self) -> NodeName:
        """The peer that it is for."""
        return self.path.peer

    @property
    def symbols(self) -> int:
        """Number of source and repair symbols."""
        return self.count + self.repairs

    @property
    def held_bytes(self) -> int:
        """Bytes that the message may occupy at the receiver before it is whole."""
        return self.total + self.repairs * self.symbol

    @property
    def newest(self) -> OutboundMessage:
        """The message that carries the bytes now: this one, or what it was cut into."""
        message = self
        while message.successor is not None:
            message = message.successor
        return message

    @property
    def may_have_left(self) -> bool:
        """Whether any of these bytes may have left, in this message or one it was cut into.

        False is certain only once the message is over: its link looks at `over` after it has set `begun`.
        """
        message = self
        while not message.begun and message.successor is not None:
            message = message.successor
        return message.begun

    @property
    def datagram_bytes(self) -> int:
        """Length of its longest datagram, with the room for the tag."""
        return min(self.total, self.symbol) + FRAGMENT_OVERHEAD_BYTES

    def cut_again(self, number: int, path: PathId, symbol: int) -> OutboundMessage:
        """Return the same bytes as another message, for paths that carry at most `symbol` bytes at once.

        Its symbols do not complete those of this one at the receiver.
        """
        shared = self in self.siblings
        self.stand_down()
        self.successor = OutboundMessage(
            number,
            path,
            self.content,
            priority=self.priority,
            deadline=self.deadline,
            expires=self.expires,
            symbol=symbol,
            answers=self.answers,
            copy_of=self.copy_of,
            repairs=-(-self.repairs * symbol_count(self.total, symbol) // self.count),
            siblings=self.siblings if shared else None,
        )
        self.successor.generation = self.generation + 1
        return self.successor

    def stand_down(self) -> None:
        """Leave the siblings, which must not rely on it: its answer is uncertain now."""
        if self in self.siblings:
            self.siblings.remove(self)

    def missing(self) -> tuple[int, ...]:
        """Return the symbols that did not arrive, as far as is known."""
        return tuple(index for index in range(self.symbols) if self.needs(index))

    def give_up(self) -> tuple[int, ...]:
        """Return what is missing, even if in flight: nobody will report it any more. For the engine only, as `lost`."""
        self._copies.clear()
        return self.missing()

    def copied(self, indices: Iterable[int]) -> None:
        """Note that these symbols travel once more than they were lost. For the engine only, as `lost`."""
        for index in indices:
            self._copies[index] = self._copies.get(index, 0) + 1

    def needs(self, index: int) -> bool:
        """Return whether this symbol still has to travel."""
        return not self.over and not self.acked[index]

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

    def lost(self, indices: Iterable[int]) -> tuple[int, ...]:
        """Note lost symbols; return the source symbols that must travel again. For the engine only, as `interfaces`.

        A symbol with another copy in flight does not. In a block that lost at most as many source symbols as it has
        repair symbols that arrived or still may, none does. A lost repair symbol never does.
        """
        indices = [index for index in indices if self.needs(index) and not self._is_copied(index)]
        if not self.repairs:
            return tuple(indices)
        blocks = fec.block_count(self.count)
        hit = set()
        for index in indices:
            if index < self.count:
                self._lost.add(index)
                hit.add(index % blocks)
            else:
                self._lost_repairs.add(index - self.count)
                hit.add((index - self.count) % blocks)
        again: list[int] = []
        for block in hit:
            uncovered = sorted(index for index in self._lost if index % blocks == block and self.needs(index))
            repairs = range(block, self.repairs, blocks)
            left = len(repairs) - sum(repair % blocks == block for repair in self._lost_repairs)
            again += uncovered[: max(0, len(uncovered) - left)]
        self._lost.difference_update(again)
        return tuple(sorted(again))

    def _is_copied(self, index: int) -> bool:
        """Return whether a lost symbol has another copy in flight, and count that copy off."""
        more = self._copies.get(index, 0)
        if more > 1:
            self._copies[index] = more - 1
        elif more:
            del self._copies[index]
        return more > 0
