"""State files decode to a value or raise DecodeError, also where the checksum is right."""

from __future__ import annotations

import contextlib
import hashlib
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import NodeName, Version
from plr.protos.model.mapping import MappingSet
from plr.protos.model.members import PeerSet
from plr.protos.model.stream import Welcome
from plr.sidecar.state.file import (
    FORMAT_VERSION,
    LAST_GOOD_VERSION,
    LastGood,
    decode_addresses,
    decode_identity,
    decode_last_good,
    encode_last_good,
)

OWNER = NodeName("robot-1")
GOOD = encode_last_good(LastGood(OWNER, Welcome(3.0, 0.5, ("s:1",)), PeerSet(Version(1), 2), MappingSet(Version(3), 4)))


def sealed(magic: bytes, body: bytes) -> bytes:
    version = LAST_GOOD_VERSION if magic == b"plr-last" else FORMAT_VERSION
    return struct.pack("!8sHI32s", magic, version, len(body), hashlib.sha256(body).digest()) + body


@given(st.binary(max_size=300))
def test_any_bytes(data: bytes) -> None:
    with pytest.raises(DecodeError):
        decode_identity(data)
    with pytest.raises(DecodeError):
        decode_last_good(data, OWNER)
    with pytest.raises(DecodeError):
        decode_addresses(data)


@given(st.binary(max_size=200))
def test_any_body_under_a_right_checksum(body: bytes) -> None:
    with contextlib.suppress(DecodeError):
        decode_identity(sealed(b"plr-id\0\0", body))
    with contextlib.suppress(DecodeError):
        decode_last_good(sealed(b"plr-last", body), OWNER)
    with contextlib.suppress(DecodeError):
        decode_addresses(sealed(b"plr-ctrl", body))
    with contextlib.suppress(DecodeError):
        decode_last_good(sealed(b"plr-last", b"\x07robot-1" + body), OWNER)


@given(st.integers(0, len(GOOD) - 1), st.integers(1, 255))
def test_any_flipped_byte_is_noticed(position: int, flip: int) -> None:
    spoilt = bytearray(GOOD)
    spoilt[position] ^= flip
    with pytest.raises(DecodeError):
        decode_last_good(bytes(spoilt), OWNER)
