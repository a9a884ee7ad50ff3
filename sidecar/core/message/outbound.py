"""Keeps what the engine knows of an outgoing message: whom it is for, and which symbols got lost."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.sidecar.core.wire import fec

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from plr.protos.model.ids import NodeName
    from plr.sidecar.core.base.values import PathId, RequestId
    from plr.sidecar.core.message.symbols import MessageSymbols


class OutboundMessage:
    """One message under way. No link sees it: links have its symbols."""

    __slots__ = (
        "_copies",
        "_lost",
        "_lost_repairs",
        "answers",
        "carriers",
        "copy_of",
        "generation",
        "interfaces",
        "number",
        "path",
        "successor",
        "symbols",
        "unreported",
    )

    def __init__(
        self,
        path: PathId,
        symbols: MessageSymbols,
        *,
        answers: RequestId | None = None,
        copy_of: RequestId | None = None,
        generation: int = 0,
        shared_by: Collection[PathId] = (),
    ) -> None:
        self.path = path
        """The path it was first sent over."""
        self.carriers = (path, *shared_by)
        """The paths that carry it together, or the one that it was first sent over."""
        self.symbols = symbols
        self.number = symbols.number
        self.interfaces = {path.interface}
        """The interfaces it was sent over."""
        for other in shared_by:
            self.interfaces.add(other.interface)
        self.answers = answers
        """The request that it answers."""
        self.copy_of = copy_of
        """The request that it is a copy of."""
        self.generation = generation
        """Number of earlier messages with the same bytes."""
        self.successor: OutboundMessage | None = None
        """The same bytes, cut again into smaller symbols."""
        self.unreported = False
        """Whether the peer, when last looked at, had enough of it but had not reported it FINISHED."""
        self._copies: dict[int, int] = {}
        """For each symbol with several datagrams in flight, how many more than one."""
        self._lost: set[int] = set()
        self._lost_repairs: set[int] = set()

    @property
    def peer(self) -> NodeName:
        """The peer that it is for."""
        return self.path.peer

    @property
    def over(self) -> bool:
        """Whether it is delivered, called off, expired or cut again: none of it has to travel any more."""
        return self.symbols.over

    @property
    def is_there(self) -> bool:
        """Whether the peer has all of it, as far as is known, or none of it has to travel any more.

        A faulty peer may acknowledge all symbols and not report the message FINISHED.
        """
        return self.symbols.over or self.symbols.arrived >= self.symbols.count

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
        while not message.symbols.begun and message.successor is not None:
            message = message.successor
        return message.symbols.begun

    def end(self) -> None:
        """Let nothing of it travel any more."""
        self.symbols.over = True

    def cut_again(self, number: int, path: PathId, symbol: int, shared_by: Collection[PathId] = ()) -> OutboundMessage:
        """Return the same bytes as another message, for paths that carry at most `symbol` bytes at once."""
        symbols = self.symbols.cut_again(number, symbol)
        self.successor = OutboundMessage(
            path,
            symbols,
            answers=self.answers,
            copy_of=self.copy_of,
            generation=self.generation + 1,
            shared_by=shared_by,
        )
        return self.successor

    def stand_down(self) -> None:
        """Leave the siblings, which must not rely on it: its answer is uncertain now."""
        self.symbols.stand_down()

    def give_up(self) -> tuple[int, ...]:
        """Return what is missing, even if in flight: nobody will report it any more."""
        self._copies.clear()
        if self.symbols.sharing is not None:
            self.symbols.sharing.take_all()  # or it would travel twice
        return self.symbols.missing()

    def copied(self, indices: Iterable[int]) -> None:
        """Note that these symbols travel once more than they were lost."""
        for index in indices:
            self._copies[index] = self._copies.get(index, 0) + 1

    def lost(self, indices: Iterable[int]) -> tuple[int, ...]:
        """Note lost symbols; return the source symbols that must travel again.

        A symbol with another copy in flight does not. In a block that lost at most as many source symbols as it has
        repair symbols that arrived or still may, none does. A lost repair symbol never does.
        """
        needs, count, all_repairs = self.symbols.needs, self.symbols.count, self.symbols.repairs
        indices = [index for index in indices if needs(index) and not self._is_copied(index)]
        if not all_repairs:
            return tuple(indices)
        blocks = fec.block_count(count)
        hit = set()
        for index in indices:
            if index < count:
                self._lost.add(index)
                hit.add(index % blocks)
            else:
                self._lost_repairs.add(index - count)
                hit.add((index - count) % blocks)
        again: list[int] = []
        for block in hit:
            uncovered = sorted(index for index in self._lost if index % blocks == block and needs(index))
            repairs = range(block, all_repairs, blocks)
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
