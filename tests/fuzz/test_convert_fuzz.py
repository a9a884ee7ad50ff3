"""Invariant: whatever the bytes, parsing a control message returns a value or raises DecodeError."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from google.protobuf.message import DecodeError as ProtobufDecodeError
from hypothesis import given, settings
from hypothesis import strategies as st

from plr.protos.base.errors import DecodeError
from plr.protos.convert import (
    control_message_to_proto,
    explanation_from_proto,
    explanation_to_proto,
    parse_control_message,
    parse_sidecar_message,
    sidecar_message_to_proto,
    status_from_proto,
    status_to_proto,
)
from plr.protos.plr.v1 import admin_pb2
from tests.unit.protos import message_strategies as some

if TYPE_CHECKING:
    import random

valid_bytes = st.one_of(
    some.sidecar_messages.map(lambda value: sidecar_message_to_proto(value).SerializeToString()),
    some.control_messages.map(lambda value: control_message_to_proto(value).SerializeToString()),
    st.lists(some.statuses, max_size=2).map(lambda value: status_to_proto(value).SerializeToString()),
    some.explanations.map(lambda value: explanation_to_proto(value).SerializeToString()),
)


def parse_as_everything(data: bytes) -> None:
    """What parses is a valid value, so that it also survives its own encoding."""
    with contextlib.suppress(DecodeError):
        sidecar = parse_sidecar_message(data)
        assert parse_sidecar_message(sidecar_message_to_proto(sidecar).SerializeToString()) == sidecar
    with contextlib.suppress(DecodeError):
        control = parse_control_message(data)
        assert parse_control_message(control_message_to_proto(control).SerializeToString()) == control
    with contextlib.suppress(DecodeError, ProtobufDecodeError):
        status = status_from_proto(admin_pb2.GetStatusResponse.FromString(data))
        assert status_from_proto(status_to_proto(status)) == status
    with contextlib.suppress(DecodeError, ProtobufDecodeError):
        explanation = explanation_from_proto(admin_pb2.ExplainResponse.FromString(data))
        assert explanation_from_proto(explanation_to_proto(explanation)) == explanation


@given(st.binary(max_size=200))
@settings(max_examples=500)
def test_arbitrary_bytes(data: bytes) -> None:
    parse_as_everything(data)


@given(valid_bytes, st.randoms(use_true_random=False))
@settings(max_examples=400)
def test_damaged_messages(valid: bytes, rng: random.Random) -> None:
    data = bytearray(valid)
    for _ in range(rng.randint(1, 4)):
        position = rng.randint(0, len(data))
        match rng.randrange(3):
            case 0:
                data[position : position + 1] = rng.randbytes(1)
            case 1:
                del data[position : position + rng.randint(1, 20)]
            case _:
                data[position:position] = rng.randbytes(rng.randint(1, 4))
    parse_as_everything(bytes(data))
