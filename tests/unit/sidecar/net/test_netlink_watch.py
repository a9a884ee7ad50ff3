from __future__ import annotations

import socket
import struct
import threading
import time

import pytest

from plr.sidecar.net.netlink_watch import (
    RTM_DELADDR,
    RTM_DELLINK,
    RTM_DELROUTE,
    RTM_NEWADDR,
    RTM_NEWLINK,
    RTM_NEWROUTE,
    NetlinkWatch,
    read_announcements,
)

RTM_NEWNEIGH = 28
UP, LOWER_UP = 0x1, 0x10000


def announcement(kind: int, body: bytes = b"") -> bytes:
    return struct.pack("=IHHII", 16 + len(body), kind, 0, 1, 0) + body + bytes(-len(body) % 4)


def link(kind: int, index: int, flags: int, family: int = socket.AF_UNSPEC) -> bytes:
    return announcement(kind, struct.pack("=BxHiII", family, 1, index, flags, 0) + b"attributes")


def route(kind: int, destination_bits: int) -> bytes:
    return announcement(kind, struct.pack("=BBBBBBBBI", socket.AF_INET, destination_bits, 0, 0, 0, 0, 0, 0, 0))


@pytest.mark.parametrize(
    ("data", "gone"),
    [
        (link(RTM_NEWLINK, 7, UP | LOWER_UP), {7: False}),
        (link(RTM_NEWLINK, 7, UP), {7: True}),
        (link(RTM_NEWLINK, 7, 0), {7: True}),
        (link(RTM_DELLINK, 7, UP | LOWER_UP), {7: True}),
        (link(RTM_NEWLINK, 7, UP) + link(RTM_NEWLINK, 7, UP | LOWER_UP), {7: False}),
        (link(RTM_NEWLINK, 7, UP) + link(RTM_NEWLINK, 8, UP), {7: True, 8: True}),
        (announcement(RTM_NEWADDR), {}),
        (announcement(RTM_DELADDR), {}),
        (route(RTM_NEWROUTE, 0), {}),
        (route(RTM_DELROUTE, 0), {}),
        (announcement(RTM_NEWLINK), {}),
        (b"\x10", {}),
        (struct.pack("=IHHII", 4096, RTM_NEWNEIGH, 0, 0, 0), {}),
        (struct.pack("=IHHII", 0, RTM_NEWNEIGH, 0, 0, 0), {}),
    ],
)
def test_what_matters_is_a_change_and_so_is_what_cannot_be_read(data: bytes, gone: dict[int, bool]) -> None:
    noted: dict[int, bool] = {}
    assert read_announcements(data, noted)
    assert noted == gone


@pytest.mark.parametrize(
    "data",
    [
        b"",
        route(RTM_NEWROUTE, 24),
        route(RTM_DELROUTE, 128),
        announcement(RTM_NEWNEIGH),
        link(RTM_DELLINK, 7, 0, family=socket.AF_BRIDGE),
        route(RTM_NEWROUTE, 24) + link(RTM_NEWLINK, 7, 0, family=socket.AF_INET6),
    ],
)
def test_what_does_not_matter_is_none(data: bytes) -> None:
    noted: dict[int, bool] = {}
    assert not read_announcements(data, noted)
    assert noted == {}


def test_waiting_ends_when_another_thread_wakes_it() -> None:
    watch = NetlinkWatch()
    watch.subscribe()
    try:
        waker = threading.Timer(0.05, watch.wake)
        started = time.monotonic()
        waker.start()
        changes = watch.wait(60.0)
        assert time.monotonic() - started < 50.0
        assert not changes.gone_links
        waker.join()
    finally:
        watch.close()


def test_without_a_subscription_it_waits_and_tells_nothing() -> None:
    watch = NetlinkWatch()
    assert watch.wait(0.01) == (False, frozenset())
    watch.close()
