"""The code gives back any erasures it has symbols for, whatever the block."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plr.sidecar.core.wire import fec

SYMBOL = 24


def symbols(rng: random.Random, count: int) -> list[bytes]:
    return [rng.randbytes(SYMBOL) for _ in range(count)]


@pytest.mark.parametrize("size", range(1, fec.MAX_BLOCK + 1))
def test_every_block_size_survives_losing_as_much_as_it_has_repairs(size: int) -> None:
    rng = random.Random(size)
    sources = symbols(rng, size)
    lost = rng.sample(range(size), rng.randint(1, size))
    rows = rng.sample(range(size), len(lost))
    received = [None if place in lost else source for place, source in enumerate(sources)]
    decoded = fec.decode(received, {row: fec.encode(sources, row) for row in rows}, 0, SYMBOL)
    assert decoded == [(place, sources[place]) for place in sorted(lost)]


@settings(max_examples=60)
@given(size=st.integers(1, fec.MAX_BLOCK), seed=st.integers(0, 2**32))
def test_all_source_symbols_may_be_lost(size: int, seed: int) -> None:
    rng = random.Random(seed)
    sources = symbols(rng, size)
    decoded = fec.decode([None] * size, {row: fec.encode(sources, row) for row in range(size)}, 0, SYMBOL)
    assert [symbol for _, symbol in decoded] == sources


def test_nothing_lost_needs_no_repair() -> None:
    assert fec.decode([b"ab", b"cd"], {}, 0, 2) == []


def test_the_repair_of_a_lone_symbol_is_its_copy() -> None:
    assert fec.encode([b"alone"], 0) == b"alone"


@given(count=st.integers(1, 0x10000))
def test_blocks_share_the_symbols_evenly_and_fit_the_field(count: int) -> None:
    blocks = fec.block_count(count)
    sizes = [fec.block_size(count, block) for block in range(blocks)]
    assert sum(sizes) == count
    assert max(sizes) <= fec.MAX_BLOCK
    assert max(sizes) - min(sizes) <= 1
    # Whatever repair index the wire allows, its row exists in its block.
    repairs = fec.max_repairs(count)
    assert count + repairs <= 0x10000
    for repair in range(max(0, repairs - blocks), repairs):
        assert repair // blocks < sizes[repair % blocks]


def test_garbage_decodes_to_garbage_without_an_error() -> None:
    rng = random.Random(1)
    sources = symbols(rng, 5)
    decoded = fec.decode([None, *sources[1:]], {3: rng.randbytes(SYMBOL)}, 0, SYMBOL)
    assert len(decoded) == 1
    assert decoded[0][1] != sources[0]
