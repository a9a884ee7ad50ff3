from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.simulated.sessions import credential_of
from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import InterfaceId, NodeName, Role, SessionId
from plr.sidecar.core.wire.frame import BASE_BYTES, Header, KeyOffer
from plr.sidecar.core.wire.introduction import (
    MAX_INTRODUCED_BYTES,
    Introduction,
    UnauthenticError,
    encode_introduction,
    hello_id,
    open_introduction,
    read_hello_id,
)

TOKEN, NAME = bytes(range(16)), NodeName("cloud-a")
HEADER = Header(InterfaceId(1), InterfaceId(2), SessionId(7), 9)
CREDENTIAL = credential_of("robot-1", Role.ROBOT, 7)


def datagram(header: Header = HEADER, token: bytes = TOKEN, name: NodeName = NAME, probe: int = 5) -> memoryview:
    return memoryview(encode_introduction(header, token, name, probe, CREDENTIAL.encode()))


def test_an_introduction_comes_back() -> None:
    assert read_hello_id(datagram()) == hello_id(TOKEN)
    assert open_introduction(HEADER, datagram(), TOKEN, NAME) == Introduction(5, None, CREDENTIAL)


def test_an_offer_of_keys_comes_back() -> None:
    offer = KeyOffer(1, bytes(range(32)), bytes(range(16)))
    data = memoryview(encode_introduction(HEADER, TOKEN, NAME, 5, CREDENTIAL.encode(), offer))
    assert open_introduction(HEADER, data, TOKEN, NAME) == Introduction(5, offer, CREDENTIAL)


def test_the_longest_credential_fits_what_every_path_carries() -> None:
    long = encode_introduction(HEADER, TOKEN, NAME, 5, bytes(MAX_INTRODUCED_BYTES))
    assert len(long) == BASE_BYTES


def test_neither_token_nor_name_nor_key_stand_in_clear() -> None:
    data = bytes(datagram())
    assert TOKEN not in data
    assert b"robot-1" not in data
    assert CREDENTIAL.public_key not in data


@pytest.mark.parametrize(
    "other",
    [
        HEADER._replace(sender_interface=InterfaceId(42)),
        HEADER._replace(receiver_interface=InterfaceId(42)),
        HEADER._replace(session=SessionId(42)),
    ],
)
def test_it_opens_as_what_it_was_sealed_only(other: Header) -> None:
    with pytest.raises(UnauthenticError):
        open_introduction(other, datagram(), TOKEN, NAME)


def test_it_is_for_one_receiver_and_of_one_who_knows_the_token() -> None:
    with pytest.raises(UnauthenticError):
        open_introduction(HEADER, datagram(), TOKEN, NodeName("cloud-b"))
    with pytest.raises(UnauthenticError):
        open_introduction(HEADER, datagram(), bytes(16), NAME)


@given(st.integers(0, 10_000), st.integers(1, 255))
def test_nothing_changed_on_its_way_opens(place: int, change: int) -> None:
    data = bytearray(datagram())
    data[place % len(data)] ^= change
    with pytest.raises(UnauthenticError):
        open_introduction(HEADER, memoryview(data), TOKEN, NAME)


@given(st.integers(0, len(datagram()) - 1))
def test_what_is_cut_short_is_refused(size: int) -> None:
    with pytest.raises(DecodeError):
        open_introduction(HEADER, datagram()[:size], TOKEN, NAME)


def test_a_credential_of_another_session_is_refused() -> None:
    other = encode_introduction(HEADER, TOKEN, NAME, 5, replace(CREDENTIAL, session=SessionId(8)).encode())
    with pytest.raises(DecodeError, match="another session"):
        open_introduction(HEADER, memoryview(other), TOKEN, NAME)


def test_sealed_bytes_never_repeat_between_paths_and_receivers() -> None:
    """The same packet number on another path, or to another peer, is sealed with another key."""
    seen = {bytes(datagram())[28:60]}
    for header in (
        HEADER._replace(sender_interface=InterfaceId(3)),
        HEADER._replace(receiver_interface=InterfaceId(3)),
    ):
        seen.add(bytes(datagram(header))[28:60])
    seen.add(bytes(datagram(name=NodeName("cloud-b")))[28:60])
    assert len(seen) == 4
