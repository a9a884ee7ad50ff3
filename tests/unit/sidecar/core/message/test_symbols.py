from __future__ import annotations

import random

import pytest

from plr.sidecar.core.message.symbols import MessageSymbols
from plr.sidecar.core.wire import fec
from plr.sidecar.core.wire.messages import Encoded
from tests.support.builders import message


def coded(count: int, repairs: int, *, head: int = 40) -> MessageSymbols:
    data = random.Random(count).randbytes(count * 1000 - 3)
    content = Encoded(data[:head], data[head:])
    symbols = MessageSymbols(1, content, deadline=1.0, expires=2.0, symbol=1000, repairs=repairs)
    assert (symbols.count, symbols.repairs) == (count, repairs)
    return symbols


@pytest.mark.parametrize("head", [0, 1, 999, 1000, 1001, 2500, 3000])
def test_symbols_cover_head_and_payload(head: int) -> None:
    data = random.Random(head).randbytes(3000)
    symbols = MessageSymbols(1, Encoded(data[:head], data[head:]), deadline=1.0, expires=2.0, symbol=1000)
    assert symbols.count == 3
    assert b"".join(symbols.symbol_data(index) for index in range(3)) == data


def test_only_symbols_with_head_in_them_are_copied() -> None:
    symbols = coded(5, 0)
    assert [isinstance(symbols.symbol_data(index), memoryview) for index in range(5)] == [False] + 4 * [True]


def test_an_empty_message_still_has_a_symbol_to_travel() -> None:
    symbols = message(size=0)
    assert symbols.missing() == (0,)
    assert bytes(symbols.symbol_data(0)) == b""


def test_acknowledged_symbols_and_messages_that_are_over_need_nothing() -> None:
    symbols = message(size=3000)
    symbols.acked[1] = 1
    assert symbols.missing() == (0, 2)
    symbols.over = True
    assert symbols.missing() == ()
    assert not symbols.needs(0)


@pytest.mark.parametrize("count", [1, 2, 3, 128, 129, 300])
def test_repair_symbols_belong_to_the_blocks_in_turn(count: int) -> None:
    blocks = fec.block_count(count)
    symbols = coded(count, min(count, 2 * blocks))
    last = symbols.count - 1
    block = last % blocks
    sources = [bytes(symbols.symbol_data(index)).ljust(symbols.symbol, b"\0") for index in range(block, count, blocks)]
    repair = bytes(symbols.symbol_data(count + block))
    assert fec.decode([*sources[:-1], None], {0: repair}, 0, symbols.symbol) == [(len(sources) - 1, sources[-1])]


def test_a_repair_symbol_is_no_longer_than_the_message() -> None:
    symbols = MessageSymbols(1, Encoded(b"h", bytes(299)), deadline=1.0, expires=2.0, repairs=1)
    assert len(symbols.symbol_data(1)) == 300


def test_cut_again_it_keeps_its_share_of_repairs_and_takes_its_place_among_its_siblings() -> None:
    symbols, shared = coded(10, 2), [message(2)]
    alone = symbols.cut_again(3, 500)
    assert (alone.count, alone.repairs, alone.siblings) == (20, 4, [])
    sibling = message(4, size=3000, siblings=shared)
    successor = sibling.cut_again(5, 500)
    assert sibling not in shared
    assert successor in shared
    assert successor.siblings is shared


def test_the_first_symbol_travels_once_more_to_ask_again() -> None:
    symbols = message(size=3000)
    symbols.acked[:] = b"\1" * len(symbols)
    assert symbols.arrived == len(symbols)
    symbols.ask_again()
    assert symbols.missing() == (0,)
