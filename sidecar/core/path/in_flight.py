"""Represents runs of datagrams in flight: consecutive packet numbers that left together, noted as one."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from plr.sidecar.core.message.symbols import MessageSymbols


class Sent(NamedTuple):
    """Ack-eliciting datagrams that left together, with consecutive packet numbers."""

    first: int
    """Packet number of the first."""
    datagrams: int
    at: float
    segment: int
    """Bytes of each datagram but the last."""
    last: int
    """Bytes of the last datagram."""
    message: MessageSymbols | None = None
    """The message whose symbols they carry, one each, in order."""
    symbol: int = 0
    """The first symbol."""
    finished: tuple[int, ...] = ()
    """The messages that it reports FINISHED; a run that reports any is a single datagram."""

    @property
    def end(self) -> int:
        """The packet number after the last."""
        return self.first + self.datagrams

    @property
    def size(self) -> int:
        """Total bytes."""
        return self.segment * (self.datagrams - 1) + self.last

    @property
    def indices(self) -> range:
        """The symbols they carry."""
        return range(self.symbol, self.symbol + self.datagrams)

    @property
    def longest(self) -> int:
        """Bytes of the longest datagram."""
        return self.segment if self.datagrams > 1 else self.last

    def within(self, shortest: int, longest: int) -> int:
        """Count the datagrams of `shortest` to `longest` bytes."""
        others = self.datagrams - 1 if shortest <= self.segment <= longest else 0
        return others + (shortest <= self.last <= longest)

    def cut(self, first: int, end: int) -> Sent:
        """Return the part with these packet numbers (`end` excluded), which must lie in it."""
        if first == self.first and end == self.first + self.datagrams:
            return self
        last = self.last if end == self.first + self.datagrams else self.segment
        symbol = self.symbol + first - self.first
        return Sent(first, end - first, self.at, self.segment, last, self.message, symbol, self.finished)
