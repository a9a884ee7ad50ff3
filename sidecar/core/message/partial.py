"""Holds a message with missing symbols: one buffer that symbols are written into as they come."""

from __future__ import annotations

import mmap
from typing import TYPE_CHECKING

from plr.sidecar.core.base.timers import NEVER
from plr.sidecar.core.wire import fec
from plr.sidecar.core.wire.frame import symbol_count

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.sidecar.core.base.values import PathId

LAZY_BYTES = 1024 * 1024
"""From this size on, a buffer's pages are claimed as they are written: announcing 16 MiB must cost nothing."""

SLICE_OPERATIONS = 4_000_000
"""Work of one slice, in multiplications of a byte: some 3 ms. The largest block spends most of that on its matrix
(`fec.decoding_cost`), again for each slice."""


class Partial:
    """The received symbols of one message, in their places.

    `have` and `buffer` are for the reassembler's loop, which writes source symbols itself.
    """

    __slots__ = (
        "_blocks",
        "_decodable_blocks",
        "_rows",
        "buffer",
        "count",
        "ends_at",
        "have",
        "missing",
        "number",
        "paths",
        "repairs",
        "symbol",
        "total",
        "touched_at",
    )

    def __init__(self, number: int, total: int, symbol: int, now: float) -> None:
        self.number = number
        self.total = total
        self.symbol = symbol
        self.count = symbol_count(total, symbol)
        self.missing = self.count
        """Number of source symbols that have not come."""
        self.have = bytearray(self.count)
        """1 for each source symbol that came."""
        self.buffer = _claim(total)
        self.paths: list[PathId] = []
        """The paths by which its symbols came."""
        self.repairs = 0
        """Number of repair symbols stored."""
        self.touched_at = now
        self.ends_at = NEVER
        """When the message stops being of use: the earliest time that a symbol told, since the symbol longest in flight
        tells too late an end."""
        self._blocks = fec.block_count(self.count)
        self._rows: dict[int, dict[int, bytes]] = {}
        """Repair symbols by block and row."""
        self._decodable_blocks = 0
        """Number of leading blocks that miss no more than they have repair symbols for, and never will again."""

    @property
    def held_bytes(self) -> int:
        """Bytes claimed by the announced size and by repair symbols."""
        return self.total + self.repairs * self.symbol

    def wants_repair(self, repair: int) -> bool:
        """Return whether this repair symbol is new and its block misses more than it has repair symbols for."""
        row, block = divmod(repair, self._blocks)
        rows = self._rows.get(block, {})
        return row not in rows and len(rows) < self._missing_in(block)

    def add_repair(self, repair: int, data: memoryview) -> None:
        """Keep a repair symbol that is wanted."""
        row, block = divmod(repair, self._blocks)
        self._rows.setdefault(block, {})[row] = bytes(data)
        self.repairs += 1

    def is_decodable(self) -> bool:
        """Return whether what is missing can be computed. Each block is looked at once in a message's life."""
        if self.missing > self.repairs:
            return False
        while self._decodable_blocks < self._blocks:
            block = self._decodable_blocks
            if self._missing_in(block) > len(self._rows.get(block, ())):
                return False
            self._decodable_blocks += 1
        return True

    def _missing_in(self, block: int) -> int:
        return self.have[block :: self._blocks].count(0)

    def whole(self) -> memoryview:
        """Return the message, which has nothing missing or is decoded."""
        return memoryview(self.buffer)

    def decode(self) -> Iterator[None]:
        """Compute what is missing, a slice at each step; then the message is `whole`. Never call it under a lock.

        A slice is SLICE_OPERATIONS at most, some milliseconds: some blocks, or some columns of one (any byte of a
        symbol depends on the same byte of the others alone). Symbols of a dishonest sender give a message of garbage.
        """
        buffer, symbol = memoryview(self.buffer), self.symbol
        left = SLICE_OPERATIONS
        for block, rows in self._rows.items():
            missing = self._missing_in(block)
            if not missing:
                continue
            indices = range(block, self.count, self._blocks)
            sources = [self._padded(buffer, index) if self.have[index] else None for index in indices]
            fixed, of_a_column = fec.decoding_cost(len(indices), missing)
            first = 0
            while first < symbol:
                columns = min(symbol - first, (left - fixed) // of_a_column)
                if columns < symbol - first and left < SLICE_OPERATIONS:
                    yield
                    left = SLICE_OPERATIONS
                    continue
                last = first + columns
                for place, data in fec.decode(sources, rows, first, last):
                    start = indices[place] * symbol
                    end = min(start + last, self.total)
                    buffer[start + first : end] = data[: max(0, end - start - first)]
                left -= fixed + columns * of_a_column
                first = last

    def _padded(self, buffer: memoryview, index: int) -> bytes | memoryview:
        start = index * self.symbol
        data = buffer[start : start + self.symbol]
        return data if len(data) == self.symbol else bytes(data).ljust(self.symbol, b"\0")


def _claim(size: int) -> bytearray | mmap.mmap:
    if size >= LAZY_BYTES:
        try:
            return mmap.mmap(-1, size)
        except OSError:  # no mappings left
            pass
    return bytearray(size)
