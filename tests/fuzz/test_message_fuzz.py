"""Whatever a peer puts into a message, the codec gives a value or its one error."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import ServiceName
from plr.protos.model.names import clean_text
from plr.sidecar.core.base.values import Priority, RejectReason, RequestId
from plr.sidecar.core.wire.messages import (
    MAX_NAME_BYTES,
    CancelMessage,
    Message,
    RejectionMessage,
    RequestMessage,
    ResponseMessage,
    RevocationLists,
    RevocationsHeld,
    RevocationsWanted,
    decode_message,
    encode_message,
)

ids = st.binary(min_size=16, max_size=16).map(RequestId)
u8, u32 = st.integers(0, 255), st.integers(0, 2**32 - 1)
names = st.text(st.characters(codec="utf-8"), max_size=60)
payloads = st.binary(max_size=200)
u64 = st.integers(0, 2**64 - 1)
messages = st.one_of(
    st.builds(RevocationsHeld, st.dictionaries(u64, u64, max_size=16)),
    st.builds(RevocationsWanted, st.dictionaries(u64, u64, max_size=16)),
    st.builds(RevocationLists, payloads),
    st.builds(
        RequestMessage,
        ids,
        u8,
        st.sampled_from(Priority),
        u32.map(lambda n: n / 1e6),
        u32.map(lambda n: n / 1e6),
        names.map(ServiceName),
        names,
        payloads,
    ),
    st.builds(ResponseMessage, ids, u8, u32.map(lambda n: n / 1e6), payloads),
    st.builds(RejectionMessage, ids, u8, st.sampled_from(RejectReason), names),
    st.builds(CancelMessage, ids),
)
framed = st.builds(lambda kind, rest: bytes([kind]) + rest, st.integers(0, 8), st.binary(max_size=400))


@given(messages)
def test_messages_come_back(message: Message) -> None:
    decoded = decode_message(memoryview(b"".join(encode_message(message))))
    assert type(decoded) is type(message)
    for name in message.__slots__:
        before, after = getattr(message, name), getattr(decoded, name)
        if isinstance(message, RejectionMessage) and name == "text":
            before = clean_text(before)  # a reason is read fit for a log: the one field that may change
        # Times lose less than their unit.
        assert after == (pytest.approx(before, abs=1e-3) if isinstance(before, float) else before)


@given(st.binary(max_size=100) | framed)
def test_a_message_or_the_one_error(data: bytes) -> None:
    try:
        message = decode_message(memoryview(data))
    except DecodeError:
        return
    kept = 17 if isinstance(message, CancelMessage) else 18  # a cancel's last byte is ignored
    assert b"".join(encode_message(message))[:kept] == data[:kept]
    if isinstance(message, RequestMessage):
        assert len(message.service.encode()) <= MAX_NAME_BYTES
        assert b"".join(encode_message(message))[27:] == data[27:]


@given(messages, st.integers(0, 300), st.binary(min_size=1, max_size=3))
def test_a_message_with_changed_bytes_is_a_message_or_the_one_error(message: Message, at: int, new: bytes) -> None:
    data = bytearray(b"".join(encode_message(message)))
    position = at % len(data)
    data[position : position + len(new)] = new
    try:
        decode_message(memoryview(bytes(data)))
    except DecodeError:
        return
