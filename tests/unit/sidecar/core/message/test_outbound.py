from __future__ import annotations

import random

from plr.sidecar.core.message.outbound import OutboundMessage
from plr.sidecar.core.message.symbols import MessageSymbols
from plr.sidecar.core.wire.messages import Encoded
from tests.support.builders import A, path


def coded(count: int, repairs: int) -> OutboundMessage:
    content = Encoded(b"", random.Random(count).randbytes(count * 1000 - 3))
    symbols = MessageSymbols(1, content, deadline=1.0, expires=2.0, symbol=1000, repairs=repairs)
    assert (symbols.count, symbols.repairs) == (count, repairs)
    return OutboundMessage(path(), symbols)


def test_a_message_is_for_the_peer_of_its_path_until_it_ends() -> None:
    outbound = coded(3, 0)
    assert outbound.peer == A
    assert outbound.give_up() == (0, 1, 2)
    outbound.end()
    assert outbound.over
    assert outbound.give_up() == ()


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
    outbound.symbols.acked[3] = 1
    assert outbound.lost([4]) == ()


def test_each_block_covers_its_own() -> None:
    outbound = coded(200, 2)
    assert outbound.lost([0, 1]) == ()
    assert outbound.lost([2]) == (0,)


def test_with_its_only_path_gone_everything_uncovered_travels_again() -> None:
    outbound = coded(10, 2)
    outbound.symbols.acked[10] = 1
    outbound.symbols.acked[0] = 1
    assert outbound.lost(outbound.symbols.missing()) == tuple(range(1, 9))


def test_cut_again_it_keeps_its_share_of_repairs() -> None:
    outbound = coded(10, 2)
    successor = outbound.cut_again(2, path(), 500)
    assert (successor.symbols.count, successor.symbols.repairs) == (20, 4)
    assert successor.generation == 1
    assert outbound.newest is successor
    assert not outbound.may_have_left
    successor.symbols.symbol_data(0)
    assert outbound.may_have_left
