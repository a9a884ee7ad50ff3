from __future__ import annotations

import socket

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plr.sidecar.net.sockets import normalise, to_sockaddr


@pytest.mark.parametrize(
    ("raw", "expected"),
    [
        (("192.0.2.1", 7), ("192.0.2.1", 7)),
        (("::ffff:192.0.2.1", 7, 0, 0), ("192.0.2.1", 7)),
        (("2001:db8::1", 7, 0, 0), ("2001:db8::1", 7)),
        (("::1", 7, 5, 0), ("::1", 7)),
        (("::ffff:0:1", 7, 0, 0), ("::ffff:0:1", 7)),
    ],
)
def test_senders_are_normalised(raw: tuple[str, int], expected: tuple[str, int]) -> None:
    assert normalise(raw) == expected


def test_an_ipv4_socket_cannot_reach_ipv6() -> None:
    assert to_sockaddr(socket.AF_INET, ("2001:db8::1", 7)) is None
    assert to_sockaddr(socket.AF_INET, ("192.0.2.1", 7)) == ("192.0.2.1", 7)


@pytest.mark.parametrize("host", ["localhost", "", "192.0.2.1:7", "example.org"])
def test_host_names_are_never_looked_up(host: str) -> None:
    with pytest.raises(ValueError, match="does not appear to be"):
        to_sockaddr(socket.AF_INET6, (host, 7))


@given(st.ip_addresses().filter(lambda ip: ip.version == 4 or ip.ipv4_mapped is None), st.integers(1, 65535))
def test_a_dual_stack_socket_reaches_every_address_and_names_it_alike(ip: object, port: int) -> None:
    address = (str(ip), port)
    raw = to_sockaddr(socket.AF_INET6, address)
    assert raw is not None
    socket.inet_pton(socket.AF_INET6, str(raw[0]))
    assert normalise(raw) == address
