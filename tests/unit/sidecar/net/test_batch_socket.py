from __future__ import annotations

import errno
import logging
import os
import random
import select
import socket
from typing import TYPE_CHECKING, Any

import pytest

from plr.protos.model.ids import InterfaceName
from plr.sidecar.core.link.sender import Batch
from plr.sidecar.core.seam.stats import LinkStats
from plr.sidecar.net.batch_socket import ARENA_BYTES, RECEIVE_CALLS, ROOM_BYTES, BatchSocket

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.protos.model.ids import Address

PATIENCE_S = 20.0
SEGMENT = 1200


class ScriptedSocket(socket.socket):
    """A UDP socket whose kernel behaves as the test says."""

    def __init__(self) -> None:
        super().__init__(socket.AF_INET, socket.SOCK_DGRAM)
        self.setblocking(False)
        self.bind(("127.0.0.1", 0))
        self.segmentation_error: int | None = None
        self.longest = 1 << 16
        """A longer datagram is refused, alone or in a run, as by a device with a small MTU."""
        self.room: int | None = None
        """Datagrams that fit into the socket's buffer."""
        self.runs_tried = 0

    def sendmsg(self, buffers: Any, *arguments: Any) -> int:
        self.runs_tried += 1
        segment = int.from_bytes(arguments[0][0][2], "little")
        if self.segmentation_error is not None:
            raise OSError(self.segmentation_error, os.strerror(self.segmentation_error))
        if segment > self.longest:
            raise OSError(errno.EMSGSIZE, "too long")
        if self.room is not None:
            raise BlockingIOError
        return super().sendmsg(buffers, *arguments)

    def sendto(self, data: Any, *arguments: Any) -> int:
        if len(data) > self.longest:
            raise OSError(errno.EMSGSIZE, "too long")
        if self.room is not None:
            if not self.room:
                raise BlockingIOError
            self.room -= 1
        return super().sendto(data, *arguments)


class End:
    """One end: a scripted socket, what it counted and whom it informed about datagrams too long."""

    def __init__(self) -> None:
        self.socket = ScriptedSocket()
        self.stats = LinkStats(InterfaceName("wlan0"))
        self.too_big: list[tuple[Address, int]] = []
        self.batches = BatchSocket(self.socket, self.stats, lambda *told: self.too_big.append(told))
        self.address: Address = self.socket.getsockname()

    def received(self, count: int) -> list[bytes]:
        """Wait for `count` datagrams, cut where they were joined."""
        found: list[bytes] = []
        while len(found) < count:
            assert select.select([self.socket], [], [], PATIENCE_S)[0], f"{len(found)} of {count}"
            found += self.take()
        return found

    def take(self) -> list[bytes]:
        found = []
        for data, segment, _ in self.batches.receive():
            found += [bytes(data[start : start + segment]) for start in range(0, len(data), segment)]
        return found


@pytest.fixture
def ends() -> Iterator[tuple[End, End]]:
    near, far = End(), End()
    with near.socket, far.socket:
        yield near, far


def batch_for(end: End, count: int, last: int = SEGMENT, seed: int = 0) -> tuple[Batch, list[bytes]]:
    """`count` datagrams, the last of `last` bytes; and the same one by one."""
    data = random.Random(seed).randbytes((count - 1) * SEGMENT + last)
    return Batch(end.address, data, SEGMENT), [data[at : at + SEGMENT] for at in range(0, len(data), SEGMENT)]


@pytest.mark.parametrize(("count", "last"), [(1, 1), (1, SEGMENT), (2, 7), (40, SEGMENT), (54, 11)])
@pytest.mark.parametrize("offload", [True, False])
def test_a_batch_arrives_as_its_datagrams(ends: tuple[End, End], count: int, last: int, offload: bool) -> None:
    near, far = ends
    if not offload:
        near.socket.segmentation_error = errno.EIO
        far.socket.setsockopt(socket.IPPROTO_UDP, 104, 0)
    batch, datagrams = batch_for(far, count, last)
    assert near.batches.send(batch) is None
    assert far.received(count) == datagrams
    assert not near.stats.dropped
    assert not far.stats.dropped


def test_views_and_bytearrays_are_sent_as_they_are(ends: tuple[End, End]) -> None:
    near, far = ends
    batch, datagrams = batch_for(far, 3)
    near.batches.send(batch._replace(data=bytearray(batch.data)))
    near.batches.send(batch._replace(data=memoryview(batch.data)))
    assert far.received(6) == datagrams * 2


@pytest.mark.parametrize("error", [errno.EIO, errno.EINVAL, errno.EMSGSIZE, errno.EOPNOTSUPP])
def test_a_kernel_that_refuses_to_segment_costs_nothing_but_system_calls(
    ends: tuple[End, End], error: int, caplog: pytest.LogCaptureFixture
) -> None:
    near, far = ends
    near.socket.segmentation_error = error
    batch, datagrams = batch_for(far, 5, last=9)
    with caplog.at_level(logging.INFO):
        for _ in range(3):
            assert near.batches.send(batch) is None
    assert far.received(15) == datagrams * 3
    assert near.socket.runs_tried == 1
    assert near.stats.offload["send"] is False
    assert not near.stats.dropped
    assert not near.too_big
    assert caplog.text.count("wlan0: the kernel does not segment datagrams") == 1


def test_datagrams_too_long_for_the_device_are_reported_and_the_rest_leaves(ends: tuple[End, End]) -> None:
    near, far = ends
    near.socket.longest = SEGMENT - 1
    batch, datagrams = batch_for(far, 4, last=100)
    assert near.batches.send(batch) is None
    assert far.received(1) == datagrams[-1:]
    assert near.stats.dropped == {"unsendable_emsgsize": 3}
    assert near.too_big == [(far.address, SEGMENT)]
    # Segmentation itself was not at fault.
    assert near.stats.offload["send"] is True
    near.socket.longest = SEGMENT
    near.batches.send(batch)
    assert far.received(4) == datagrams
    assert near.socket.runs_tried == 2


def test_an_error_of_the_way_out_drops_the_batch_and_counts_its_datagrams(ends: tuple[End, End]) -> None:
    near, far = ends
    near.socket.segmentation_error = errno.ENETUNREACH
    assert near.batches.send(batch_for(far, 5, last=9)[0]) is None
    assert near.stats.dropped == {"unsendable_enetunreach": 5}
    assert near.stats.offload["send"] is True


def test_another_family_is_unsendable(ends: tuple[End, End]) -> None:
    near, _ = ends
    assert near.batches.send(Batch(("fd00::1", 9), bytes(30), 10)) is None
    assert near.stats.dropped == {"unsendable_eafnosupport": 3}


def test_what_a_full_buffer_left_is_handed_back_and_can_be_sent_later(ends: tuple[End, End]) -> None:
    near, far = ends
    batch, datagrams = batch_for(far, 6, last=5)
    near.socket.room = 0
    assert near.batches.send(batch) == batch
    near.socket.segmentation_error, near.socket.room = errno.EIO, 4
    rest = near.batches.send(batch)
    assert rest is not None
    assert bytes(rest.data) == b"".join(datagrams[4:])
    near.socket.room = None
    assert near.batches.send(rest) is None
    assert far.received(6) == datagrams
    assert near.stats.dropped == {"send_buffer_full_waits": 2}


def test_runs_of_one_sender_come_as_one_even_when_the_kernel_joins_nothing(ends: tuple[End, End]) -> None:
    near, far = ends
    far.socket.setsockopt(socket.IPPROTO_UDP, 104, 0)
    for size in (10, 10, 10, 4, 10, 10, 30):
        near.socket.sendto(bytes(size), far.address)
    runs = far.batches.receive()
    assert [(len(run.data), run.segment) for run in runs] == [(34, 10), (20, 10), (30, 30)]
    assert {run.source for run in runs} == {near.address}


def test_senders_are_kept_apart(ends: tuple[End, End]) -> None:
    near, far = ends
    with End().socket as third:
        for sender in (near.socket, third, near.socket, near.socket):
            sender.sendto(b"same size", far.address)
        runs = far.batches.receive()
        assert [run.source for run in runs] == [near.address, third.getsockname(), near.address]
    assert [len(run.data) for run in runs] == [9, 9, 18]


@pytest.mark.parametrize("seed", range(8))
def test_every_datagram_keeps_its_bounds_and_its_place(ends: tuple[End, End], seed: int) -> None:
    near, far = ends
    rng = random.Random(seed)
    sent: list[bytes] = []
    for _ in range(30):
        segment, count = rng.choice((1, 10, 100, 1200)), rng.randrange(1, 6)
        data = rng.randbytes(segment * count - rng.randrange(segment))
        near.batches.send(Batch(far.address, data, segment))
        sent += [data[at : at + segment] for at in range(0, len(data), segment)]
    assert far.received(len(sent)) == sent


def test_one_turn_takes_a_bounded_amount(ends: tuple[End, End]) -> None:
    near, far = ends
    for size in range(1, 2 * RECEIVE_CALLS):
        near.socket.sendto(bytes(size), far.address)
    assert len(far.take()) == RECEIVE_CALLS
    far.take()
    batch, _ = batch_for(far, 50)
    for _ in range(8):
        near.batches.send(batch)
    taken = sum(len(run.data) for run in far.batches.receive())
    assert ARENA_BYTES - 2 * ROOM_BYTES < taken <= ARENA_BYTES


def test_empty_datagrams_are_malformed(ends: tuple[End, End]) -> None:
    near, far = ends
    for data in (b"a", b"", b"b"):
        near.socket.sendto(data, far.address)
    assert far.take() == [b"a", b"b"]
    assert far.stats.dropped == {"malformed": 1}
