"""Corrects losses without retransmission: systematic Reed-Solomon over GF(256), in blocks.

A message's symbols are dealt to blocks in turn, symbol i to block i mod B, so that a burst of losses hits every block a
little. Repair symbol r belongs to block r mod B and is that block's row r div B. Any k symbols of a block of k restore
it (Rizzo, "Effective Erasure Codes for Reliable Computer Communication Protocols", 1997).

Only this file knows the codec. zfec releases the interpreter lock while it computes, about 0.4 us for each source
symbol of 1150 bytes and each repair symbol.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Protocol

from zfec import Decoder, Encoder

if TYPE_CHECKING:
    from collections.abc import Sequence

MAX_BLOCK = 128
"""Source symbols of one block. Large blocks need fewer repair symbols for the same protection, but each costs time in
proportion to the block. With as many repair symbols the field of 256 is full."""

SYMBOL_COST = 512
"""Cost of handing one symbol to the codec, in multiplications of a byte."""


class _Codec(Protocol):
    def encode(self, blocks: Sequence[object], numbers: Sequence[int]) -> list[bytes]: ...

    def decode(self, blocks: Sequence[object], numbers: Sequence[int]) -> list[bytes]: ...


def block_count(count: int) -> int:
    """Return the number of blocks of a message of `count` source symbols."""
    return -(-count // MAX_BLOCK)


def max_repairs(count: int) -> int:
    """Return the most repair symbols for `count` source symbols whose indices still fit 16 bits."""
    return min(count, 0x10000 - count)


def block_size(count: int, block: int) -> int:
    """Return the number of source symbols of one block."""
    blocks = block_count(count)
    return (count - block + blocks - 1) // blocks


def encode(sources: Sequence[bytes | bytearray | memoryview], row: int) -> bytes:
    """Return repair symbol `row` (0 <= row < len(sources)) of a block of equally long source symbols."""
    size = len(sources)
    return _encoder(size).encode(sources, (size + row,))[0]


def decode(
    sources: Sequence[bytes | memoryview | None], repairs: dict[int, bytes], first: int, last: int
) -> list[tuple[int, bytes]]:
    """Return bytes `first` to `last` of a block's missing (None) source symbols, with their places.

    `repairs` holds at least as many as are missing, by row (0 <= row < len(sources)); all symbols are equally long.
    """
    size = len(sources)
    blocks: list[object] = [None if source is None else source[first:last] for source in sources]
    numbers = list(range(size))
    rows = iter(repairs.items())
    missing = [place for place, source in enumerate(sources) if source is None]
    for place in missing:
        # zfec wants every source symbol in its own place, and never returns if a number comes twice.
        row, repair = next(rows)
        blocks[place] = repair[first:last]
        numbers[place] = size + row
    decoded = _decoder(size).decode(tuple(blocks), tuple(numbers))
    return [(place, decoded[place]) for place in missing]


def decoding_cost(size: int, missing: int) -> tuple[int, int]:
    """Return the cost of decoding a block of `size` source symbols, in multiplications of a byte (0.8 ns).

    The first number is the cost of each call of `decode`, the second the additional cost of each column of bytes.
    """
    # It inverts the rows of the missing symbols, and looks at each symbol. Measured with 1 to 128 missing of 128.
    return missing * missing * size + size * SYMBOL_COST, missing * size


# At most MAX_BLOCK entries each; a table of 128 rows costs half a millisecond to make and 32 kB to keep. The codecs
# hold nothing but their table: threads share them.
@cache
def _encoder(size: int) -> _Codec:
    codec: _Codec = Encoder(size, 2 * size)
    return codec


@cache
def _decoder(size: int) -> _Codec:
    codec: _Codec = Decoder(size, 2 * size)
    return codec
