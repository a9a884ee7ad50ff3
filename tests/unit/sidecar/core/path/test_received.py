from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from plr.sidecar.core.path.received import ACK_EVERY, MAX_ACK_DELAY_S, STALE_PACKETS, ReceivedPackets
from plr.sidecar.core.wire.frame import MAX_ACK_RANGES


def received(*numbers: int) -> ReceivedPackets:
    packets = ReceivedPackets()
    for number in numbers:
        assert packets.add(number, 1.0)
    return packets


def ranges(packets: ReceivedPackets) -> list[tuple[int, int]]:
    return packets.take_ack(1.0)[0]


def test_ranges_grow_join_and_stay_sorted() -> None:
    assert ranges(received(5)) == [(5, 5)]
    assert ranges(received(5, 6, 7)) == [(5, 7)]
    assert ranges(received(5, 7)) == [(7, 7), (5, 5)]
    assert ranges(received(5, 7, 6)) == [(5, 7)]
    assert ranges(received(10, 5, 7, 6, 4, 9)) == [(9, 10), (4, 7)]
    assert ranges(received(10, 2, 6)) == [(10, 10), (6, 6), (2, 2)]


def test_a_number_counts_once() -> None:
    packets = received(5, 7, 3)
    for number in (5, 7, 3):
        assert not packets.add(number, 1.0)
    assert ranges(packets) == [(7, 7), (5, 5), (3, 3)]


def test_the_oldest_ranges_are_forgotten_and_nothing_of_them_is_taken_again() -> None:
    packets = received(*range(0, 4 * MAX_ACK_RANGES, 2))
    assert len(ranges(packets)) == MAX_ACK_RANGES
    lowest = ranges(packets)[-1][0]
    assert not packets.add(lowest - 2, 1.0), "a forgotten one came before"
    assert not packets.add(lowest - 3, 1.0), "it may have come before"
    assert packets.add(lowest - 1, 1.0), "it did not"
    assert not packets.add(0, 1.0)
    assert packets.add(lowest + 1, 1.0), "it closes a gap that is remembered"


def test_a_leap_makes_everything_far_below_stale_not_new() -> None:
    packets = received(1, 2, 3)
    assert packets.add(3 + STALE_PACKETS + 1, 1.0)
    for number in (1, 2, 3):
        assert not packets.add(number, 1.0)
    assert packets.add(4, 1.0)
    assert ranges(packets) == [(3 + STALE_PACKETS + 1,) * 2, (4, 4)]


def test_a_lone_datagram_is_acknowledged_soon_and_several_at_once() -> None:
    assert received(1).ack_at is None
    packets = received(1)
    packets.owe_ack(1.0)
    assert packets.ack_at == 1.0 + MAX_ACK_DELAY_S
    for number in range(2, ACK_EVERY + 1):
        assert packets.ack_at == 1.0 + MAX_ACK_DELAY_S
        packets.add(number, 1.001)
        packets.owe_ack(1.001)
    assert packets.ack_at == 1.001
    assert packets.take_ack(1.003) == ([(1, ACK_EVERY)], 1.003 - 1.001)
    assert packets.ack_at is None


def test_a_gap_and_a_late_filler_are_acknowledged_at_once() -> None:
    for numbers in ((1, 3), (3, 1)):
        packets = received(*numbers)
        packets.owe_ack(2.0)
        assert packets.ack_at == 2.0
        packets.take_ack(2.0)
    packets.add(4, 2.0)
    packets.owe_ack(2.0)
    assert packets.ack_at == 2.0 + MAX_ACK_DELAY_S, "the old gap is no news"


def test_a_duplicate_owes_nothing_new() -> None:
    packets = received(1, 2)
    packets.take_ack(1.0)
    packets.add(1, 1.0)
    packets.add(3, 1.0)
    packets.owe_ack(1.0)
    assert packets.ack_at == 1.0 + MAX_ACK_DELAY_S


near = st.integers(0, 200)
numbers = st.lists(near | near.map(lambda number: number * 37) | st.integers(0, 2**64 - 1), max_size=400)


@given(numbers)
@settings(max_examples=300)
def test_no_number_is_ever_taken_twice_whatever_is_forgotten(arrivals: list[int]) -> None:
    """The replay window: what was forgotten is refused (RFC 6479 in effect)."""
    packets, taken = ReceivedPackets(), set[int]()
    for number in arrivals + arrivals[::-1]:
        if packets.add(number, 1.0):
            assert number not in taken
            taken.add(number)
    assert len(packets._ranges) <= MAX_ACK_RANGES
    largest = max(arrivals, default=0)
    assert not any(packets.add(number, 1.0) for number in arrivals)
    assert packets.add(largest + 1, 1.0)


@given(st.lists(st.tuples(st.integers(0, 40), st.integers(1, 64)), max_size=60), numbers)
def test_runs_and_single_ones_together_are_never_taken_twice(runs: list[tuple[int, int]], singles: list[int]) -> None:
    packets, taken = ReceivedPackets(), set[int]()
    for (gap, length), single in zip(runs, singles, strict=False):
        low = packets.largest + 1 + gap
        packets.add_run(low, low + length - 1, 1.0)
        assert taken.isdisjoint(range(low, low + length))
        taken.update(range(low, low + length))
        number = single % (packets.largest + 3)
        if packets.add(number, 1.0):
            assert number not in taken
            taken.add(number)
