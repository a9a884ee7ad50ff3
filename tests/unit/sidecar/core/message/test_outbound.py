from __future__ import annotations

import random

import pytest

from plr.sidecar.core.message.outbound import OutboundMessage
from plr.sidecar.core.wire import fec
from plr.sidecar.core.wire.messages import Encoded
from tests.support.builders import A, message, path


def coded(count: int, repairs: int, *, head: int = 40) -> OutboundMessage:
    data = random.Random(count).randbytes(count * 1000 - 3)
    content = Encoded(data[:head], data[head:])
    outbound = OutboundMessage(1, path(), content, deadline=1.0, expires=2.0, symbol=1000, repairs=repairs)
    assert (outbound.count, outbound.repairs) == (count, repairs)
    return outbound


@pytest.mark.parametrize("head", [0, 1, 999, 1000, 1001, 2500, 3000])
def test_symbols_cover_head_and_payload(head: int) -> None:
    data = random.Random(head).randbytes(3000)
    outbound = OutboundMessage(1, path(), Encoded(data[:head], data[head:]), deadline=1.0, expires=2.0, symbol=1000)
    assert outbound.count == 3
    assert b"".join(outbound.symbol_data(index) for index in range(3)) == data
    assert outbound.peer == A


def test_only_symbols_with_head_in_them_are_copied() -> None:
    outbound = coded(5, 0)
    assert [isinstance(outbound.symbol_data(index), memoryview) for index in range(5)] == [False] + 4 * [True]


def test_an_empty_message_still_has_a_symbol_to_travel() -> None:
    outbound = message(size=0)
    assert outbound.missing() == (0,)
    assert bytes(outbound.symbol_data(0)) == b""


def test_acknowledged_symbols_and_messages_that_are_over_need_nothing() -> None:
    outbound = message(size=3000)
    outbound.acked[1] = 1
    assert outbound.missing() == (0, 2)
    outbound.over = True
    assert outbound.missing() == ()
    assert not outbound.needs(0)


@pytest.mark.parametrize("count", [1, 2, 3, 128, 129, 300])
def test_repair_symbols_belong_to_the_blocks_in_turn(count: int) -> None:
    blocks = fec.block_count(count)
    outbound = coded(count, min(count, 2 * blocks))
    last = outbound.count - 1
    block = last % blocks
    sources = [
        bytes(outbound.symbol_data(index)).ljust(outbound.symbol, b"\0") for index in range(block, count, blocks)
    ]
    repair = bytes(outbound.symbol_data(count + block))
    assert fec.decode([*sources[:-1], None], {0: repair}, 0, outbound.symbol) == [(len(sources) - 1, sources[-1])]


def test_a_repair_symbol_is_no_longer_than_the_message() -> None:
    outbound = OutboundMessage(1, path(), Encoded(b"h", bytes(299)), deadline=1.0, expires=2.0, repairs=1)
    assert len(outbound.symbol_data(1)) == 300


def test_what_repairs_cover_does_not_travel_again() -> None:
    outbound = coded(10, 2)
    assert outbound.lost([3]) == ()
    assert outbound.lost([5]) == ()
    # A third loss is one too many: one of the three travels again, whichever.
    assert len(outbound.lost([7])) == 1
    assert outbound.lost([]) == ()


def test_a_lost_repair_is_not_sent_again_but_what_it_covered_is() -> None:
    outbound = coded(10, 2)
    assert outbound.lost([3, 10]) == ()
    assert outbound.lost([11]) == (3,)
    # And again when that one is lost, too.
    assert outbound.lost([3]) == (3,)


def test_a_symbol_that_was_only_late_is_not_missed() -> None:
    outbound = coded(10, 1)
    assert outbound.lost([3]) == ()
    outbound.acked[3] = 1
    assert outbound.lost([4]) == ()


def test_each_block_covers_its_own() -> None:
    outbound = coded(200, 2)
    assert outbound.lost([0, 1]) == ()
    assert outbound.lost([2]) == (0,)


def test_with_its_only_path_gone_everything_uncovered_travels_again() -> None:
    outbound = coded(10, 2)
    outbound.acked[10] = 1
    outbound.acked[0] = 1
    assert outbound.lost(outbound.missing()) == tuple(range(1, 9))


def test_cut_again_it_keeps_its_share_of_repairs() -> None:
    outbound = coded(10, 2)
    successor = outbound.cut_again(2, path(), 500)
    assert (successor.count, successor.repairs) == (20, 4)
    assert outbound.newest is successor
