"""Damaged gRPC messages and state files by the ten thousand: a value or the one error, and memory stays.

`--fuzz-datagrams 1000000` (make fuzz) is the long version: so many of each.
"""

from __future__ import annotations

import contextlib
import gc
import random
from typing import TYPE_CHECKING

import psutil
import pytest
from google.protobuf.message import DecodeError as ProtobufDecodeError
from hypothesis import given, settings
from hypothesis import strategies as st

from lab.attacker.junk import flipped, mangled, noise
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
from plr.protos.model.ids import NodeName
from plr.protos.plr.v1 import admin_pb2
from plr.sidecar.state import file
from plr.sidecar.state.file import LastGood
from tests.fuzz.test_state_file_fuzz import sealed
from tests.unit.protos import message_strategies as some

if TYPE_CHECKING:
    from collections.abc import Callable

CORPUS = 100
"""Good ones of each kind, of which the damaged ones are made."""
ROUNDS = 20
"""Looks at the memory."""
GROWTH_BYTES = 24e6
"""Resident memory that may come on top after a fifth, whatever the number: allocators round up."""
OWNER = NodeName("robot-1")


def corpus(strategy: st.SearchStrategy[bytes]) -> list[bytes]:
    """The same good ones at each run."""
    found: list[bytes] = []

    @settings(max_examples=CORPUS, derandomize=True, database=None)
    @given(strategy)
    def collect(data: bytes) -> None:
        found.append(data)

    collect()
    return found


def damaged(good: bytes, rng: random.Random) -> bytes:
    match rng.randrange(4):
        case 0:
            return flipped(good, rng) if good else noise(rng)
        case 1:
            return mangled(good, rng) if good else noise(rng)
        case 2:
            return noise(rng)
        case _:
            cut = rng.randrange(len(good) + 1)
            return good[:cut] + rng.randbytes(rng.randrange(8)) + good[cut:]


def feed(count: int, make: Callable[[random.Random], bytes], parse: Callable[[bytes], bool]) -> int:
    """Return how many were accepted."""
    rng = random.Random(1)
    taken, grown = 0, []
    for _ in range(ROUNDS):
        for _ in range(count // ROUNDS):
            taken += parse(make(rng))
        gc.collect()
        grown.append(psutil.Process().memory_info().rss)
    assert grown[-1] - grown[ROUNDS // 5] < GROWTH_BYTES
    return taken


def parses(parse: Callable[[bytes], object], data: bytes) -> bool:
    with contextlib.suppress(DecodeError, ProtobufDecodeError):
        parse(data)
        return True
    return False


MESSAGES: dict[str, tuple[st.SearchStrategy[bytes], Callable[[bytes], object]]] = {
    "of a sidecar": (
        some.sidecar_messages.map(lambda value: sidecar_message_to_proto(value).SerializeToString()),
        parse_sidecar_message,
    ),
    "of the control plane": (
        some.control_messages.map(lambda value: control_message_to_proto(value).SerializeToString()),
        parse_control_message,
    ),
    "status": (
        st.lists(some.statuses, max_size=2).map(lambda value: status_to_proto(value).SerializeToString()),
        lambda data: status_from_proto(admin_pb2.GetStatusResponse.FromString(data)),
    ),
    "explanation": (
        some.explanations.map(lambda value: explanation_to_proto(value).SerializeToString()),
        lambda data: explanation_from_proto(admin_pb2.ExplainResponse.FromString(data)),
    ),
}


@pytest.mark.parametrize("kind", MESSAGES)
def test_damaged_messages(kind: str, fuzz_datagrams: int) -> None:
    strategy, parse = MESSAGES[kind]
    good = corpus(strategy)
    count = max(100 * ROUNDS, fuzz_datagrams // len(MESSAGES))
    taken = feed(count, lambda rng: damaged(rng.choice(good), rng), lambda data: parses(parse, data))
    assert 0 < taken < count, "some damage leaves a message, most does not"


FILES: dict[str, tuple[bytes, Callable[[bytes], object]]] = {
    "identity": (b"plr-id\0\0", file.decode_identity),
    "last good": (b"plr-last", lambda data: file.decode_last_good(data, OWNER)),
    "addresses": (b"plr-ctrl", file.decode_addresses),
    "revocations": (b"plr-crls", file.decode_revocations),
    "clock": (b"plr-clck", file.decode_clock_floor),
}
SEAL_BYTES = 46
NEEDS_A_FIXED_LENGTH = (b"plr-id\0\0", b"plr-clck")


@pytest.mark.parametrize("kind", FILES)
def test_damaged_state_files(kind: str, fuzz_datagrams: int) -> None:
    """Half of them under a right checksum, as an older or a hostile program would leave them."""
    magic, decode = FILES[kind]
    last_good = st.builds(LastGood, st.just(OWNER), some.welcomes, some.peer_sets(), some.mapping_sets)
    bodies = [
        *corpus(last_good.map(lambda last: file.encode_last_good(last)[SEAL_BYTES:])),
        bytes(40),
        b"\x00\x04a:50051",
    ]

    def make(rng: random.Random) -> bytes:
        body = damaged(rng.choice(bodies), rng)
        return sealed(magic, body) if rng.random() < 0.5 else damaged(sealed(magic, body), rng)

    count = max(100 * ROUNDS, fuzz_datagrams // len(FILES))
    taken = feed(count, make, lambda data: parses(decode, data))
    assert taken < count
    assert taken > 0 or magic in NEEDS_A_FIXED_LENGTH
