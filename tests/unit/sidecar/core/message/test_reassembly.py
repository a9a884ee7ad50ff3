from __future__ import annotations

import random
import tracemalloc
from collections import Counter

import pytest

from plr.sidecar.core.message.partial import Partial
from plr.sidecar.core.message.reassembly import (
    MAX_PEER_BYTES,
    MAX_PEER_MESSAGES,
    MAX_SILENCE_S,
    OVER_REMEMBERED,
    Fate,
    Reassembled,
    Reassembler,
)
from plr.sidecar.core.message.symbols import MessageSymbols
from plr.sidecar.core.wire.frame import MAX_MESSAGE_BYTES, Fragment, symbol_count
from plr.sidecar.core.wire.messages import Encoded
from tests.support.builders import WLAN, WWAN, A, path

SYMBOL = 256


def symbols(number: int, data: bytes, symbol: int = SYMBOL) -> list[Fragment]:
    return [
        Fragment(number, len(data), symbol, index, memoryview(data)[index * symbol : (index + 1) * symbol])
        for index in range(symbol_count(len(data), symbol))
    ]


def coded(number: int, data: bytes, repairs: int, symbol: int = SYMBOL) -> list[Fragment]:
    """Source and repair symbols, as they come out of a sender."""
    message = MessageSymbols(number, Encoded(b"", data), deadline=1.0, expires=2.0, symbol=symbol, repairs=repairs)
    return [
        Fragment(number, len(data), message.symbol, index, memoryview(message.symbol_data(index)))
        for index in range(len(message))
    ]


def contents(results: list[Reassembled]) -> list[bytes]:
    """The messages that were completed, decoded where they have to be."""
    found = [result.content for result in results if result.content is not None]
    for content in found:
        if isinstance(content, Partial):
            for _ in content.decode():
                pass
    return [bytes(content.whole() if isinstance(content, Partial) else content) for content in found]


@pytest.fixture
def dropped() -> Counter[str]:
    return Counter()


@pytest.fixture
def reassembler(dropped: Counter[str]) -> Reassembler:
    return Reassembler(A, dropped)


def add_each(reassembler: Reassembler, fragments: list[Fragment], now: float = 1.0) -> list[Reassembled]:
    return [result for fragment in fragments for result in reassembler.add([fragment], now)]


@pytest.mark.parametrize("size", [0, 1, SYMBOL, SYMBOL + 1, 10 * SYMBOL, 10 * SYMBOL + 7])
def test_symbols_in_any_order_with_duplicates_give_the_message_once(reassembler: Reassembler, size: int) -> None:
    rng = random.Random(size)
    data = rng.randbytes(size)
    fragments = symbols(1, data) * 3
    rng.shuffle(fragments)
    results = add_each(reassembler, fragments)
    assert contents(results) == [data]
    assert {(result.number, result.fate) for result in results} == {(1, Fate.FINISHED)}
    assert reassembler.held_bytes == 0


def test_a_batch_hears_of_each_message_once(reassembler: Reassembler) -> None:
    one, two = random.Random(1).randbytes(600), random.Random(2).randbytes(700)
    batch = [fragment for pair in zip(symbols(1, one), symbols(2, two), strict=True) for fragment in pair]
    results = reassembler.add([*batch, *batch, symbols(3, bytes(600))[0]], 1.0)
    assert contents(results) == [one, two]
    assert [result.number for result in results] == [1, 2]
    assert reassembler.add(batch, 1.0) == [Reassembled(1, Fate.FINISHED, None), Reassembled(2, Fate.FINISHED, None)]
    assert len(reassembler) == 1


def test_a_symbol_of_another_shape_is_dropped_and_counted(reassembler: Reassembler, dropped: Counter[str]) -> None:
    data = bytes(1000)
    first, *rest = symbols(1, data)
    reassembler.add([first], 1.0)
    assert reassembler.add([symbols(1, bytes(1001))[1], symbols(1, data, symbol=300)[1]], 1.0) == []
    assert dropped["fragment_mismatch"] == 2
    assert contents(reassembler.add(rest, 1.0)) == [data]


@pytest.mark.parametrize("count", [1, 2, 7, 128, 129, 300, 2000])
@pytest.mark.parametrize("seed", range(3))
def test_repair_symbols_stand_in_for_lost_ones(reassembler: Reassembler, count: int, seed: int) -> None:
    rng = random.Random(1000 * seed + count)
    data = rng.randbytes(count * SYMBOL - rng.randrange(SYMBOL))
    every = coded(1, data, repairs=max(1, count // 4))
    rng.shuffle(every)
    results: list[Reassembled] = []
    while not contents(results):
        assert every, "all came, and it is not complete"
        results = reassembler.add([every.pop()], 1.0)
    assert contents(results) == [data]
    assert reassembler.held_bytes == 0
    assert all(result.content is None for result in add_each(reassembler, every))


def test_any_losses_up_to_the_repairs_of_a_block_are_made_good(reassembler: Reassembler) -> None:
    data = random.Random(5).randbytes(100 * SYMBOL - 9)
    for number in range(100):
        every = coded(number, data, repairs=8)
        lost = random.Random(number).sample(range(len(every)), 8)
        assert contents(reassembler.add([every[i] for i in range(len(every)) if i not in lost], 1.0)) == [data]


def test_repairs_that_are_no_news_are_not_kept(reassembler: Reassembler) -> None:
    data = random.Random(1).randbytes(10 * SYMBOL)
    every = coded(1, data, repairs=5)
    reassembler.add(every[:8], 1.0)
    held = reassembler.held_bytes
    assert held == len(data)
    reassembler.add([every[10], every[10], every[10]], 1.0)
    assert reassembler.held_bytes == held + SYMBOL
    assert contents(reassembler.add([every[9]], 1.0)) == [data]


def test_garbage_repairs_give_a_message_and_no_error(reassembler: Reassembler) -> None:
    data = bytes(10 * SYMBOL)
    every = coded(1, data, repairs=3)
    garbage = every[11]._replace(data=memoryview(random.Random(1).randbytes(SYMBOL)))
    [content] = contents(reassembler.add([*every[:9], garbage], 1.0))
    assert content != data
    assert len(content) == len(data)


def announce(reassembler: Reassembler, number: int, total: int, now: float = 1.0) -> None:
    assert reassembler.add([Fragment(number, total, SYMBOL, 0, memoryview(bytes(SYMBOL)))], now) == []


def test_announced_bytes_are_capped_the_longest_without_news_goes(
    reassembler: Reassembler, dropped: Counter[str]
) -> None:
    room = MAX_PEER_BYTES // MAX_MESSAGE_BYTES
    for number in range(room):
        announce(reassembler, number, MAX_MESSAGE_BYTES)
    reassembler.add([Fragment(0, MAX_MESSAGE_BYTES, SYMBOL, 1, memoryview(bytes(SYMBOL)))], 2.0)
    announce(reassembler, room, MAX_MESSAGE_BYTES)
    assert dropped["reassembly_evicted"] == 1
    assert reassembler.held_bytes <= MAX_PEER_BYTES
    assert 0 in reassembler._partials, "it had news"
    assert 1 not in reassembler._partials


def test_repair_symbols_count_towards_the_cap(reassembler: Reassembler, dropped: Counter[str]) -> None:
    data = bytes(1000 * SYMBOL)
    every = coded(1, data, repairs=1000)
    room = MAX_PEER_BYTES - len(data) - 10 * SYMBOL
    reassembler.add(every[:1], 1.0)
    for number in range(2, 2 + room // MAX_MESSAGE_BYTES + 1):
        announce(reassembler, number, min(room, MAX_MESSAGE_BYTES))
        room -= MAX_MESSAGE_BYTES
    add_each(reassembler, every[1000:1020], 2.0)
    assert reassembler.held_bytes <= MAX_PEER_BYTES
    assert dropped["reassembly_evicted"] == 1
    assert 1 in reassembler._partials


def test_a_million_unfinished_messages_hold_bounded_memory(reassembler: Reassembler, dropped: Counter[str]) -> None:
    """Each fragment opens another message; after the cap, nothing grows."""
    announced = 20_000

    def flood(numbers: range) -> None:
        for number in numbers:
            announce(reassembler, number, 300)

    flood(range(announced))
    assert len(reassembler) == MAX_PEER_MESSAGES
    tracemalloc.start()
    try:
        flood(range(announced, 2 * announced))
        grown, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    # What was evicted was allocated before tracing began: all that is held now counts as grown.
    assert grown < MAX_PEER_MESSAGES * 2000
    assert len(reassembler) == MAX_PEER_MESSAGES
    assert len(reassembler._over) == OVER_REMEMBERED
    assert dropped["reassembly_evicted"] == 2 * announced - MAX_PEER_MESSAGES
    assert reassembler.held_bytes == MAX_PEER_MESSAGES * 300


def test_announcing_the_largest_messages_touches_no_memory(reassembler: Reassembler) -> None:
    tracemalloc.start()
    try:
        for number in range(100):
            announce(reassembler, number, MAX_MESSAGE_BYTES)
        grown, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert grown < 1024 * 1024
    assert reassembler.held_bytes <= MAX_PEER_BYTES


def test_symbols_do_not_keep_their_datagram(reassembler: Reassembler) -> None:
    datagram = bytearray(1200)
    view = memoryview(datagram)
    source, repair = Fragment(1, 700, SYMBOL, 1, view[:SYMBOL]), Fragment(1, 700, SYMBOL, 3, view[:SYMBOL])
    reassembler.add([source, repair], 1.0)
    del source, repair
    view.release()
    datagram.extend(b"x")  # would raise BufferError while a view of it lives


def test_the_old_expire_and_the_others_stay(reassembler: Reassembler, dropped: Counter[str]) -> None:
    announce(reassembler, 1, 1000, now=1.0)
    announce(reassembler, 2, 1000, now=5.0)
    reassembler.expire(1.0 + MAX_SILENCE_S - 0.1)
    assert len(reassembler) == 2
    reassembler.expire(1.0 + MAX_SILENCE_S)
    assert len(reassembler) == 1
    assert dropped["reassembly_expired"] == 1
    assert reassembler.held_bytes == 1000


def test_what_was_dropped_unfinished_is_said_to_be_forgotten(reassembler: Reassembler) -> None:
    first, *rest = symbols(1, bytes(1000))
    reassembler.add([first], 1.0)
    reassembler.expire(1.0 + MAX_SILENCE_S)
    assert reassembler.add(rest, 40.0) == [Reassembled(1, Fate.FORGOTTEN, None)]
    assert len(reassembler) == 0


def test_an_abandoned_message_goes_and_its_late_symbols_open_nothing(
    reassembler: Reassembler, dropped: Counter[str]
) -> None:
    first, *rest = symbols(1, bytes(1000))
    reassembler.add([first], 1.0)
    reassembler.abandon(1)
    assert reassembler.held_bytes == 0
    assert dropped["reassembly_abandoned"] == 1
    assert reassembler.add(rest, 1.0) == []
    # Nothing had come of this one yet; its symbols may be behind the frame.
    reassembler.abandon(2)
    assert reassembler.add(symbols(2, bytes(1000)), 1.0) == []
    assert len(reassembler) == 0


def test_abandoning_what_is_finished_changes_nothing(reassembler: Reassembler) -> None:
    reassembler.add(symbols(1, bytes(1000)), 1.0)
    reassembler.abandon(1)
    assert reassembler.add(symbols(1, bytes(1000)), 1.0) == [Reassembled(1, Fate.FINISHED, None)]


def test_finished_numbers_are_remembered_up_to_a_cap(reassembler: Reassembler) -> None:
    for number in range(OVER_REMEMBERED + 1):
        assert contents(reassembler.add(symbols(number, b"x"), 1.0)) == [b"x"]
    assert contents(reassembler.add(symbols(1, b"x"), 1.0)) == []
    assert contents(reassembler.add(symbols(0, b"x"), 1.0)) == [b"x"], "the oldest was forgotten"
    assert len(reassembler._over) == OVER_REMEMBERED


def test_a_message_tells_by_which_paths_it_came(reassembler: Reassembler) -> None:
    every = symbols(1, bytes(1001))
    reassembler.add(every[:1], 1.0, path(WLAN))
    reassembler.add(every[1:2], 1.0, path(WWAN))
    (found,) = reassembler.add(every[2:], 1.0, path(WLAN))
    assert found.paths == [path(WLAN), path(WWAN)]
