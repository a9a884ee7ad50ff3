from __future__ import annotations

import pytest

from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import InterfaceId, SessionId
from plr.sidecar.core.crypto.aead import TAG_BYTES
from plr.sidecar.core.wire import frame
from plr.sidecar.core.wire.frame import AckFrame, Close, Finished, Fragment, Header, Probe, ProbeReply

HEADER = Header(InterfaceId(1), InterfaceId(2), SessionId(0x0102030405060708), 0x1112131415161718)
CLEAR = "d3 01 01 02 01 02 03 04 05 06 07 08 11 12 13 14 15 16 17 18"
SYMBOL = bytes(range(256))

GOLDENS = {
    "probe": (frame.encode_probe(Probe(0xA1B2C3D4E5F60718)), "01 a1b2c3d4e5f60718", Probe(0xA1B2C3D4E5F60718)),
    "probe reply": (frame.encode_probe_reply(ProbeReply(5)), "02 0000000000000005", ProbeReply(5)),
    "ack": (
        frame.encode_ack([(90, 100), (80, 85), (3, 3)], 0.001234),
        "03 0000000000000064 000004d2 03 000a 0000 0005 0003 0000 004b",
        AckFrame(((90, 100), (80, 85), (3, 3)), 0.001234),
    ),
    "fragment": (
        frame.encode_fragment_head(7, 300, 256, 0, 1_500_000) + SYMBOL,
        "04 0000000000000007 0000012c 0100 0000 0016e360" + SYMBOL.hex(),
        Fragment(7, 300, 256, 0, memoryview(SYMBOL), 1_500_000),
    ),
    "finished": (frame.encode_finished(Finished(9)), "06 0000000000000009", Finished(9)),
    "close": (frame.encode_close(), "08", Close()),
}


@pytest.mark.parametrize("kind", GOLDENS)
def test_the_bytes_of_a_datagram_of_each_kind(kind: str) -> None:
    encoded, golden, value = GOLDENS[kind]
    datagram = frame.encode_header(HEADER) + encoded
    assert datagram == bytes.fromhex(CLEAR + golden)
    assert frame.decode_header(datagram) == HEADER
    assert frame.decode_frames(memoryview(datagram)[frame.HEADER_BYTES :]) == [value]


def test_room_is_left_for_the_tag() -> None:
    overhead = frame.HEADER_BYTES + len(frame.encode_fragment_head(1, 1, 256, 0)) + TAG_BYTES
    assert overhead + frame.BASE_SYMBOL_BYTES == frame.BASE_BYTES == 1200
    assert overhead + frame.MAX_SYMBOL_BYTES == frame.MAX_DATAGRAM_BYTES == 8952


def test_padding_is_skipped_wherever_it_stands() -> None:
    probe, padding = frame.encode_probe(Probe(1)), frame.encode_padding(1000)
    for data in (probe + padding, padding + probe, padding + probe + padding):
        assert frame.decode_frames(memoryview(data)) == [Probe(1)]


def test_the_last_fragment_is_shorter_and_an_empty_message_has_one() -> None:
    for total, index, length in ((300, 1, 44), (256, 0, 256), (0, 0, 0)):
        data = frame.encode_fragment_head(1, total, 256, index) + bytes(length)
        (fragment,) = frame.decode_frames(memoryview(data))
        assert isinstance(fragment, Fragment)
        assert len(fragment.data) == length


def test_several_frames_in_a_datagram_keep_their_order() -> None:
    data = frame.encode_probe(Probe(1)) + frame.encode_close() + frame.encode_probe(Probe(2))
    assert frame.decode_frames(memoryview(data)) == [Probe(1), Close(), Probe(2)]


def test_the_newest_ranges_are_told_when_there_are_more_than_fit() -> None:
    ranges = [(number, number) for number in range(200, 0, -2)]
    (ack,) = frame.decode_frames(memoryview(frame.encode_ack(ranges, 0.0)))
    assert isinstance(ack, AckFrame)
    assert list(ack.ranges) == ranges[: frame.MAX_ACK_RANGES]


def test_a_range_or_gap_too_wide_to_tell_ends_the_ack_at_its_newest_part() -> None:
    for ranges, told in (
        ([(0, 70_000)], [(70_000 - 65_535, 70_000)]),
        ([(70_000, 70_001), (0, 1)], [(70_000, 70_001)]),
        ([(65_538, 65_539), (0, 1)], [(65_538, 65_539), (0, 1)]),
    ):
        (ack,) = frame.decode_frames(memoryview(frame.encode_ack(ranges, 0.0)))
        assert isinstance(ack, AckFrame)
        assert list(ack.ranges) == told


def test_another_version_is_told_from_garbage() -> None:
    datagram = frame.encode_header(HEADER)
    with pytest.raises(frame.VersionError, match="version 1"):
        frame.decode_header(b"\xd1" + datagram[1:])
    for bad in (b"\x00" + datagram[1:], datagram[:-1], b"", datagram[:1] + b"\x09" + datagram[2:]):
        with pytest.raises(DecodeError) as error:
            frame.decode_header(bad)
        assert not isinstance(error.value, frame.VersionError | frame.UnsealedError)


def test_a_datagram_in_clear_is_told_from_garbage() -> None:
    with pytest.raises(frame.UnsealedError):
        frame.decode_header(frame.encode_header(HEADER._replace(flags=0)))


def test_the_nonce_is_half_of_the_session_and_the_packet_number() -> None:
    clear = frame.encode_header(HEADER)
    assert clear[frame.NONCE_OFFSET :].hex() == "05060708" + "1112131415161718"


BROKEN = {
    "nothing": "",
    "nothing but padding": "00" * 100,
    "unknown type": "0a",
    "reserved type": "05",
    "truncated probe": "01 0000",
    "what was HELLO before sealing": "09" + "00" * 24,
    "truncated finished": "06 00",
    "ack of nothing": "03 0000000000000064 00000000 00",
    "ack with too many ranges": "03 0000000000000064 00000000 21" + "0000 0000" * 33,
    "ack with missing ranges": "03 0000000000000064 00000000 02 0000 0000",
    "ack range below zero": "03 0000000000000001 00000000 01 0002 0000",
    "ack gap below zero": "03 0000000000000001 00000000 02 0000 0000 0000 0000",
    "fragment truncated": "04 0000000000000007 0000012c 0100 0000" + "00" * 255,
    "fragment past the end": "04 0000000000000007 0000012c 0100 0002",
    "fragment of nothing past the end": "04 0000000000000007 00000000 0100 0001",
    "fragment with a tiny symbol": "04 0000000000000007 0000012c 00ff 0000" + "00" * 255,
    "fragment with a symbol that no datagram holds": "04 0000000000000007 00100000 22c4 0075" + "00" * 7276,
    "fragment of a giant": "04 0000000000000007 01000401 0100 0000" + "00" * 256,
    "whole frame then garbage": "08 ff",
    "65 frames": "08" * 65,
}


@pytest.mark.parametrize("kind", BROKEN)
def test_broken_frames_are_refused(kind: str) -> None:
    with pytest.raises(DecodeError):
        frame.decode_frames(memoryview(bytes.fromhex(BROKEN[kind])))


@pytest.mark.audit("dp-2")
def test_one_datagram_acknowledges_once() -> None:
    """Each acknowledgement is work, and a peer could put 64 of them into a datagram."""
    ack = frame.encode_ack([(90, 100)], 0.0)
    with pytest.raises(DecodeError, match="more than one"):
        frame.decode_frames(memoryview(ack + frame.encode_probe(Probe(1)) + ack))
