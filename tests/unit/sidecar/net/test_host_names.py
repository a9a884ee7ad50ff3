from __future__ import annotations

import queue
import socket
import threading
import time
from typing import TYPE_CHECKING, Any

import pytest

from plr.sidecar.net import host_names
from plr.sidecar.net.host_names import HostNames

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.protos.model.ids import Address

TIMEOUT_S = 30.0


@pytest.fixture
def found() -> Iterator[tuple[HostNames, queue.Queue[tuple[Address, ...]]]]:
    results: queue.Queue[tuple[Address, ...]] = queue.Queue()
    names = HostNames("STUN server", results.put)
    yield names, results
    names.stop()


@pytest.mark.audit("sec-5")
def test_names_that_change_all_the_time_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """Who tells them aims us at whom they name."""
    monkeypatch.setattr(host_names, "NEW_NAMES_AT_ONCE", 1.0)
    monkeypatch.setattr(host_names, "HELD_BACK_S", 0.1)
    results: queue.Queue[tuple[Address, ...]] = queue.Queue()
    names = HostNames("STUN server", results.put)
    names.look_up(("192.0.2.1:1",))
    names.start()
    assert results.get(timeout=TIMEOUT_S) == (("192.0.2.1", 1),)
    for port in range(2, 200):
        names.look_up((f"192.0.2.1:{port}",))
        time.sleep(0.001)
    assert results.get(timeout=TIMEOUT_S) == (("192.0.2.1", 199),), "none in between"
    names.stop()


def test_numeric_addresses_are_found_at_once_and_again_only_when_they_change(
    found: tuple[HostNames, queue.Queue[tuple[Address, ...]]],
) -> None:
    names, results = found
    names.look_up(("192.0.2.1:3478", "[2001:db8::1]:3479"))
    names.start()
    assert results.get(timeout=TIMEOUT_S) == (("192.0.2.1", 3478), ("2001:db8::1", 3479))
    names.look_up(("192.0.2.1:3478", "[2001:db8::1]:3479"))
    names.look_up(("192.0.2.2:3478",))
    assert results.get(timeout=TIMEOUT_S) == (("192.0.2.2", 3478),)
    assert results.empty()


def test_numeric_addresses_do_not_wait_for_names_and_names_keep_what_they_had(
    found: tuple[HostNames, queue.Queue[tuple[Address, ...]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    answering = threading.Event()
    lost = threading.Event()

    def getaddrinfo(host: str, port: int, **_: Any) -> list[Any]:
        assert answering.wait(TIMEOUT_S)
        if lost.is_set():
            raise socket.gaierror("no such host")
        return [(socket.AF_INET, socket.SOCK_DGRAM, 17, "", ("192.0.2.9", port))]

    monkeypatch.setattr(socket, "getaddrinfo", getaddrinfo)
    names, results = found
    wanted = ("name.example:1", "192.0.2.1:2")
    names.look_up(wanted)
    names.start()
    assert results.get(timeout=TIMEOUT_S) == (("192.0.2.1", 2),)
    answering.set()
    assert results.get(timeout=TIMEOUT_S) == (("192.0.2.9", 1), ("192.0.2.1", 2))
    lost.set()
    names.look_up((*wanted, "192.0.2.3:3"))
    assert results.get(timeout=TIMEOUT_S) == (("192.0.2.9", 1), ("192.0.2.1", 2), ("192.0.2.3", 3))


def test_a_name_without_address_is_logged_once_and_tried_again(
    found: tuple[HostNames, queue.Queue[tuple[Address, ...]]],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    asked = threading.Semaphore(0)
    failures = 3

    def getaddrinfo(host: str, port: int, **_: Any) -> list[Any]:
        nonlocal failures
        asked.release()
        if failures:
            failures -= 1
            raise socket.gaierror("no such host")
        return [(socket.AF_INET, socket.SOCK_DGRAM, 17, "", ("192.0.2.9", port))]

    monkeypatch.setattr(host_names, "RETRY_S", 0.01)
    monkeypatch.setattr(socket, "getaddrinfo", getaddrinfo)
    names, results = found
    names.look_up(("stun.example:3478",))
    names.start()
    assert results.get(timeout=TIMEOUT_S) == (("192.0.2.9", 3478),)
    assert caplog.text.count("stun.example:3478: no such host") == 1
