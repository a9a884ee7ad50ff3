"""Computing messages from repair symbols: a bounded part at a time, each peer in turn, no more than fits in line."""

from __future__ import annotations

import random
from collections import Counter
from typing import TYPE_CHECKING

import pytest

from plr.protos.model.ids import NodeName, SessionId
from plr.sidecar.core.message import decoding
from plr.sidecar.core.message.decoding import MAX_DECODING_BYTES, Decoding, DecodingLine
from plr.sidecar.core.message.partial import SLICE_OPERATIONS, Partial
from plr.sidecar.core.message.reassembly import Reassembler
from plr.sidecar.core.message.symbols import MessageSymbols
from plr.sidecar.core.seam.links import SendFinished, SendForgotten
from plr.sidecar.core.seam.stats import EngineStats
from plr.sidecar.core.transfer.inbound import Inbound
from plr.sidecar.core.wire import fec
from plr.sidecar.core.wire.fec import MAX_BLOCK, decoding_cost
from plr.sidecar.core.wire.frame import Fragment, symbol_count
from plr.sidecar.core.wire.messages import Encoded
from tests.support.builders import WLAN, A, path

if TYPE_CHECKING:
    from plr.sidecar.core.seam.links import PathCommand

pytestmark = pytest.mark.audit("dp-10")


def undecoded(total: int, symbol: int, lost: float = 1.0) -> Partial:
    """A message of which this part of the source symbols was lost; its symbols are made up."""
    count = symbol_count(total, symbol)
    data = memoryview(bytes(symbol))
    first = int(count * (1 - lost))
    sources = [Fragment(1, total, symbol, index, data[: min(symbol, total - index * symbol)]) for index in range(first)]
    repairs = [Fragment(1, total, symbol, index, data) for index in range(count, 2 * count)]
    (result,) = Reassembler(A, Counter()).add([*sources, *repairs], 0.0)
    assert isinstance(result.content, Partial)
    return result.content


class Operations:
    """What the codec was asked for since the last look, in multiplications of a byte, by its own account."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.count = 0
        self._decode = fec.decode
        monkeypatch.setattr(fec, "decode", self._counting)

    def _counting(
        self, sources: list[bytes | memoryview | None], repairs: dict[int, bytes], first: int, last: int
    ) -> list[tuple[int, bytes]]:
        decoded = self._decode(sources, repairs, first, last)
        assert all(len(data) == last - first for _, data in decoded)
        self.count += len(decoded) ** 2 * len(sources) + len(decoded) * len(sources) * (last - first)
        return decoded


@pytest.mark.parametrize(("total", "symbol"), [(2**20, 1100), (2**20, 8900), (250 * 256, 256), (8 * 2**20, 1100)])
@pytest.mark.parametrize("lost", [0.02, 0.3, 1.0])
def test_a_slice_does_a_bounded_part(monkeypatch: pytest.MonkeyPatch, total: int, symbol: int, lost: float) -> None:
    operations = Operations(monkeypatch)
    work = Decoding(path(), SessionId(1), undecoded(total, symbol, lost))
    slices, whole, over = 0, 0, False
    while not over:
        over = work.run_slice()
        assert operations.count <= SLICE_OPERATIONS
        whole += operations.count
        slices, operations.count = slices + 1, 0
    assert slices <= 1 + 4 * whole / SLICE_OPERATIONS, "it does not cut up what fits together"


def test_the_dearest_block_leaves_room_in_a_slice() -> None:
    fixed, of_a_column = decoding_cost(MAX_BLOCK, MAX_BLOCK)
    assert fixed + 64 * of_a_column < SLICE_OPERATIONS


@pytest.mark.parametrize("size", [1500, 5000, 200_000, 2**20 + 7])
def test_slices_give_the_message(size: int) -> None:
    rng = random.Random(size)
    data = rng.randbytes(size)
    count = symbol_count(size, 1100)
    message = MessageSymbols(1, Encoded(b"", data), deadline=1.0, expires=2.0, symbol=1100, repairs=count)
    lost = set(rng.sample(range(count), max(1, count // 3)))
    reassembler = Reassembler(A, Counter())
    content = None
    for index in range(len(message)):
        if index not in lost and content is None:
            symbol = memoryview(message.symbol_data(index))
            found = reassembler.add([Fragment(1, size, message.symbol, index, symbol)], 0.0)
            content = found[0].content if found else None
    assert isinstance(content, Partial)
    work = Decoding(path(), SessionId(1), content)
    while not work.run_slice():
        pass
    assert work.partial.whole() == data


def at(peer: str, partial: Partial) -> Decoding:
    return Decoding(path(WLAN, peer), SessionId(1), partial)


def test_peers_have_their_slices_in_turn() -> None:
    """One that sends what takes long to decode delays another's message by a slice of its own each time."""
    line = DecodingLine()
    for _ in range(3):
        line.add(at("greedy", undecoded(2**20, 1100)))
    line.add(at("honest", undecoded(150_000, 1100, lost=0.05)))
    order: list[str] = []
    while not order or order[-1] != "honest":
        work = line.next()
        assert work is not None
        order.append(work.path.peer)
        if work.run_slice():
            line.done(work)
    assert order == ["greedy", "honest"]
    assert len(line) == 3


def test_a_slice_that_its_peers_session_does_not_outlive_is_not_taken() -> None:
    line = DecodingLine()
    old = at("robot", undecoded(5000, 1100))
    line.add(old)
    assert line.next() is old
    assert line.forget_peer(NodeName("robot")) == 1
    new = at("robot", undecoded(5000, 1100))
    line.add(new)
    assert not line.done(old)
    assert line.next() is new
    assert line.done(new)
    assert line.next() is None
    assert len(line) == 0


def test_one_peer_leaves_room_for_the_others() -> None:
    line = DecodingLine()
    large = undecoded(2**20, 1100)
    while line.fits(A, large):
        line.add(at(A, large))
    assert (len(line) - 1) * large.held_bytes <= MAX_DECODING_BYTES // 2
    assert line.fits(NodeName("robot"), undecoded(16 * 2**20, 1100))
    line.forget_peer(A)
    assert line.fits(A, large)


def test_what_finds_no_room_in_line_is_sent_again_by_its_sender(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decoding, "MAX_DECODING_MESSAGES", 4)
    told: list[PathCommand] = []
    stats = EngineStats()
    inbound = Inbound(told.append, stats, answers=False)
    robot, symbol = path(WLAN, "robot"), memoryview(bytes(300))
    for number in (1, 2, 3):
        inbound.add(robot, SessionId(1), [Fragment(number, 600, 300, index, symbol) for index in (1, 2)], 0.0)
    assert [type(command) for command in told] == [SendFinished, SendFinished, SendForgotten]
    assert stats.dropped["decoding_full"] == 1
    # Whatever still comes of it is answered so as well: that one word may be lost.
    inbound.add(robot, SessionId(1), [Fragment(3, 600, 300, 0, symbol)], 0.0)
    assert told[-1] == SendForgotten(robot, 3)
    assert inbound.decodings == 2
    inbound.forget_peer(robot.peer)
    assert inbound.next_decoding() is None
    assert stats.dropped["fragment_of_old_session"] == 2


def test_a_message_that_is_given_up_is_counted() -> None:
    stats = EngineStats()
    inbound = Inbound(lambda _: None, stats, answers=False)
    robot = path(WLAN, "robot")
    inbound.add(robot, SessionId(1), [Fragment(1, 600, 300, index, memoryview(bytes(300))) for index in (1, 2)], 0.0)
    work = inbound.next_decoding()
    assert work is not None
    inbound.forgo_decoding(work)
    assert inbound.take_decoded(work) is None
    assert stats.dropped["decoding_failed"] == 1
