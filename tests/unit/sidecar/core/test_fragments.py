from __future__ import annotations

import random
from collections import Counter

import pytest

from sidecar.core.fragments import (
    FINISHED_REMEMBERED,
    MAX_AGE_S,
    MAX_PEER_BYTES,
    MAX_PEER_MESSAGES,
    Progress,
    Reassembler,
)
from sidecar.core.frame import MAX_MESSAGE_BYTES, Fragment, symbol_count
from tests.unit.sidecar.core.builders import A

SYMBOL = 256


def symbols(number: int, data: bytes, symbol: int = SYMBOL) -> list[Fragment]:
    return [
        Fragment(number, len(data), symbol, index, memoryview(data)[index * symbol : (index + 1) * symbol])
        for index in range(symbol_count(len(data), symbol))
    ]


def whole(result: memoryview | Progress) -> bytes | None:
    return None if isinstance(result, Progress) else bytes(result)


@pytest.fixture
def dropped() -> Counter[str]:
    return Counter()


@pytest.fixture
def reassembler(dropped: Counter[str]) -> Reassembler:
    return Reassembler(A, dropped)


@pytest.mark.parametrize("size", [0, 1, SYMBOL, SYMBOL + 1, 10 * SYMBOL, 10 * SYMBOL + 7])
def test_symbols_in_any_order_with_duplicates_give_the_message_once(reassembler: Reassembler, size: int) -> None:
    rng = random.Random(size)
    data = rng.randbytes(size)
    fragments = symbols(1, data) * 3
    rng.shuffle(fragments)
    results = [reassembler.add(fragment, 1.0) for fragment in fragments]
    assert [whole(result) for result in results if not isinstance(result, Progress)] == [data]
    assert results[-1] is Progress.ALREADY_FINISHED or len(fragments) == 3
    assert reassembler.held_bytes == 0


def test_interleaved_messages_do_not_mix(reassembler: Reassembler) -> None:
    one, two = bytes(600), b"\1" * 600
    results = [
        reassembler.add(fragment, 1.0)
        for pair in zip(symbols(1, one), symbols(2, two), strict=True)
        for fragment in pair
    ]
    assert [bytes(result) for result in results[-2:] if not isinstance(result, Progress)] == [one, two]


def test_a_symbol_of_another_shape_is_dropped_and_counted(reassembler: Reassembler, dropped: Counter[str]) -> None:
    data = bytes(1000)
    first, *rest = symbols(1, data)
    reassembler.add(first, 1.0)
    for other in (symbols(1, bytes(1001))[1], symbols(1, data, symbol=300)[1]):
        assert reassembler.add(other, 1.0) is Progress.DROPPED
    assert dropped["fragment_mismatch"] == 2
    assert whole([reassembler.add(fragment, 1.0) for fragment in rest][-1]) == data


def announce(reassembler: Reassembler, number: int, total: int, now: float = 1.0) -> None:
    assert reassembler.add(Fragment(number, total, SYMBOL, 0, memoryview(bytes(SYMBOL))), now) is Progress.STORED


def test_announced_bytes_are_capped_the_longest_without_news_goes(
    reassembler: Reassembler, dropped: Counter[str]
) -> None:
    room = MAX_PEER_BYTES // MAX_MESSAGE_BYTES
    for number in range(room):
        announce(reassembler, number, MAX_MESSAGE_BYTES)
    reassembler.add(Fragment(0, MAX_MESSAGE_BYTES, SYMBOL, 1, memoryview(bytes(SYMBOL))), 2.0)
    announce(reassembler, room, MAX_MESSAGE_BYTES)
    assert dropped["reassembly_evicted"] == 1
    assert reassembler.held_bytes <= MAX_PEER_BYTES
    assert 0 in reassembler._partials, "it had news"
    assert 1 not in reassembler._partials


def test_unfinished_messages_are_capped(reassembler: Reassembler, dropped: Counter[str]) -> None:
    for number in range(MAX_PEER_MESSAGES + 10):
        announce(reassembler, number, 300)
    assert len(reassembler) == MAX_PEER_MESSAGES
    assert dropped["reassembly_evicted"] == 10
    assert reassembler.held_bytes == MAX_PEER_MESSAGES * 300


def test_an_announcement_costs_no_memory(reassembler: Reassembler) -> None:
    announce(reassembler, 1, MAX_MESSAGE_BYTES)
    assert sum(len(part) for part in reassembler._partials[1].parts.values()) == SYMBOL


def test_a_small_symbol_does_not_keep_its_datagram(reassembler: Reassembler) -> None:
    datagram = bytearray(1200)
    reassembler.add(Fragment(1, 300, SYMBOL, 1, memoryview(datagram)[:44]), 1.0)
    datagram.extend(b"x")  # would raise BufferError while a view of it lives


def test_the_old_expire_and_the_others_stay(reassembler: Reassembler, dropped: Counter[str]) -> None:
    announce(reassembler, 1, 1000, now=1.0)
    announce(reassembler, 2, 1000, now=5.0)
    reassembler.expire(1.0 + MAX_AGE_S - 0.1)
    assert len(reassembler) == 2
    reassembler.expire(1.0 + MAX_AGE_S)
    assert len(reassembler) == 1
    assert dropped["reassembly_expired"] == 1
    assert reassembler.held_bytes == 1000


def test_a_duplicate_symbol_is_no_news(reassembler: Reassembler) -> None:
    announce(reassembler, 1, 1000, now=1.0)
    announce(reassembler, 1, 1000, now=20.0)
    reassembler.expire(1.0 + MAX_AGE_S)
    assert len(reassembler) == 0


def test_finished_numbers_are_remembered_up_to_a_cap(reassembler: Reassembler) -> None:
    for number in range(FINISHED_REMEMBERED + 1):
        assert whole(reassembler.add(symbols(number, b"x")[0], 1.0)) == b"x"
    assert reassembler.add(symbols(1, b"x")[0], 1.0) is Progress.ALREADY_FINISHED
    assert whole(reassembler.add(symbols(0, b"x")[0], 1.0)) == b"x", "the oldest was forgotten"
    assert len(reassembler._finished) == FINISHED_REMEMBERED
