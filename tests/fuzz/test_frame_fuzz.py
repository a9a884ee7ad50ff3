"""Whatever bytes come, the frame codec gives values or its one error, and what it writes it reads back."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import InterfaceId, SessionId
from plr.sidecar.core.wire import frame
from plr.sidecar.core.wire.frame import AckFrame, Finished, Fragment, Header, Probe, ProbeReply

u8, u16, u32, u64 = (st.integers(0, 2**bits - 1) for bits in (8, 16, 32, 64))
headers = st.builds(
    Header, u8.map(InterfaceId), u8.map(InterfaceId), u64.map(SessionId), u64, st.sampled_from([1, 3, 5])
)


@st.composite
def ack_ranges(draw: st.DrawFn) -> list[tuple[int, int]]:
    """Inclusive ranges, highest first, with at least one number missing between two."""
    high = draw(u64)
    ranges = []
    for _ in range(draw(st.integers(1, 40))):
        low = max(0, high - draw(st.integers(0, 3) | u16 | u32))
        ranges.append((low, high))
        high = low - 2 - draw(st.integers(0, 3) | u16 | u32)
        if high < 0:
            break
    return ranges


@st.composite
def fragments(draw: st.DrawFn) -> tuple[bytes, Fragment]:
    symbol = draw(st.integers(frame.MIN_SYMBOL_BYTES, frame.MAX_SYMBOL_BYTES))
    total = draw(st.integers(0, 5 * symbol) | st.integers(0, frame.MAX_MESSAGE_BYTES))
    count = frame.symbol_count(total, symbol)
    index = draw(st.integers(0, min(2 * count - 1, 0xFFFF)))
    number = draw(u64)
    data = bytes(min(symbol, total - index * symbol) if index < count else symbol)
    encoded = frame.encode_fragment_head(number, total, symbol, index) + data
    return encoded, Fragment(number, total, symbol, index, memoryview(data))


whole_frames = st.one_of(
    u32.map(lambda n: (frame.encode_probe(Probe(n)), Probe(n))),
    u32.map(lambda n: (frame.encode_probe_reply(ProbeReply(n)), ProbeReply(n))),
    u64.map(lambda n: (frame.encode_finished(Finished(n)), Finished(n))),
    u64.map(lambda n: (frame.encode_abandon(frame.Abandon(n)), frame.Abandon(n))),
    u64.map(lambda n: (frame.encode_forgotten(frame.Forgotten(n)), frame.Forgotten(n))),
    st.just((frame.encode_close(), frame.Close())),
    fragments(),
)
typed_noise = st.builds(lambda kind, rest: bytes([kind]) + rest, st.integers(0, 12), st.binary(max_size=60))
bodies = st.binary(max_size=200) | st.lists(typed_noise, max_size=4).map(b"".join)


@given(headers)
def test_headers_come_back(header: Header) -> None:
    assert frame.decode_header(frame.encode_header(header)) == header


@given(st.lists(whole_frames, min_size=1, max_size=frame.MAX_FRAMES))
def test_frames_come_back_in_order(pairs: list[tuple[bytes, frame.Frame]]) -> None:
    encoded = b"".join(data for data, _ in pairs)
    assert frame.decode_frames(memoryview(encoded)) == [value for _, value in pairs]


@given(st.lists(whole_frames, min_size=1, max_size=4), st.integers(0, frame.MAX_DATAGRAM_BYTES))
def test_padding_adds_nothing(pairs: list[tuple[bytes, frame.Frame]], size: int) -> None:
    encoded = b"".join(data for data, _ in pairs) + frame.encode_padding(size)
    assert frame.decode_frames(memoryview(encoded)) == [value for _, value in pairs]


@given(ack_ranges(), st.floats(0, 10_000))
def test_an_ack_tells_a_prefix_of_the_ranges_and_nothing_that_did_not_come(
    ranges: list[tuple[int, int]], delay_s: float
) -> None:
    (ack,) = frame.decode_frames(memoryview(frame.encode_ack(ranges, delay_s)))
    assert isinstance(ack, AckFrame)
    assert ack.ranges[0][1] == ranges[0][1]
    assert len(ack.ranges) <= frame.MAX_ACK_RANGES
    for told, (low, high) in zip(ack.ranges, ranges, strict=False):
        assert told[1] == high
        assert low <= told[0] <= high
    assert all(told == given for told, given in zip(ack.ranges[:-1], ranges, strict=False))
    assert ack.delay_s <= delay_s + 1e-6


@given(bodies)
def test_frames_or_the_one_error(data: bytes) -> None:
    try:
        frames = frame.decode_frames(memoryview(data))
    except DecodeError:
        return
    assert 1 <= len(frames) <= frame.MAX_FRAMES
    for item in frames:
        if isinstance(item, AckFrame):
            numbers = [number for low, high in item.ranges for number in (high, low)]
            assert numbers == sorted(numbers, reverse=True)
            assert numbers[-1] >= 0
        elif isinstance(item, Fragment):
            assert item.total <= frame.MAX_MESSAGE_BYTES
            count = frame.symbol_count(item.total, item.symbol)
            if item.symbol_index < count:
                assert item.symbol_index * item.symbol + len(item.data) <= item.total
            else:
                assert item.symbol_index - count < count
                assert len(item.data) == item.symbol


@given(st.binary(max_size=40) | st.binary(max_size=40).map(lambda rest: b"\xd3\x01" + rest))
def test_a_header_or_the_one_error(data: bytes) -> None:
    try:
        header = frame.decode_header(data)
    except DecodeError:
        return
    assert frame.encode_header(header) == data[: frame.HEADER_BYTES]


@given(whole_frames, st.data())
def test_a_cut_frame_is_refused(pair: tuple[bytes, frame.Frame], data: st.DataObject) -> None:
    cut = pair[0][: data.draw(st.integers(0, len(pair[0]) - 1))]
    try:
        frame.decode_frames(memoryview(cut))
    except DecodeError:
        return
    raise AssertionError(f"decoded {len(cut)} of {len(pair[0])} bytes")
