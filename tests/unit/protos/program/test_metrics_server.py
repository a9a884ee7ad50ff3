"""The metrics page is there for those who ask for it, whoever else holds connections open."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
import urllib.request
from typing import TYPE_CHECKING

import pytest
from prometheus_client import CollectorRegistry, Gauge

from plr.protos.program import metrics_server
from plr.protos.program.metrics_server import MAX_SCRAPES, MetricsServer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[MetricsServer]:
    monkeypatch.setattr(metrics_server._Handler, "timeout", 0.5)
    registry = CollectorRegistry()
    Gauge("plr_answer", "What is asked for.", registry=registry).set(42)
    one = MetricsServer("127.0.0.1", 0, registry)
    yield one
    one.close()


def scrape(server: MetricsServer) -> str:
    with urllib.request.urlopen(f"http://127.0.0.1:{server.port}/metrics", timeout=10.0) as answer:
        text: str = answer.read().decode()
    return text


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def handlers() -> int:
    return sum("process_request_thread" in thread.name for thread in threading.enumerate())


def test_it_serves(server: MetricsServer) -> None:
    assert "plr_answer 42.0" in scrape(server)


def test_connections_that_say_nothing_are_few_and_end(server: MetricsServer) -> None:
    before = handlers()
    with contextlib.ExitStack() as stack:
        idle = [
            stack.enter_context(socket.create_connection(("127.0.0.1", server.port), 10.0))
            for _ in range(4 * MAX_SCRAPES)
        ]
        idle[0].sendall(b"GET /metrics HT")
        # The last ones find no room, the first ones run out of time: all are closed by the other side.
        with contextlib.suppress(ConnectionError):
            assert idle[-1].recv(1) == b""
        assert handlers() - before <= MAX_SCRAPES
        for one in idle:
            with contextlib.suppress(ConnectionError):
                assert one.recv(1) == b""
    assert "plr_answer 42.0" in scrape(server)


@pytest.mark.audit("ops-7")
def test_a_port_in_use_is_warned_of_once_and_taken_when_it_is_free(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    taken = socket.create_server(("127.0.0.1", 0))
    one = MetricsServer("127.0.0.1", taken.getsockname()[1], CollectorRegistry(), retry_s=0.01)
    time.sleep(0.1)
    assert not one.is_listening
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "metrics_listen: cannot listen on 127.0.0.1" in caplog.text
    taken.close()
    wait_for(lambda: one.is_listening)
    scrape(one)
    assert caplog.records[-1].levelname == "INFO"
    one.close()


def test_one_that_never_had_its_port_ends(server: MetricsServer) -> None:
    one = MetricsServer("127.0.0.1", server.port, CollectorRegistry())
    one.close()
    assert not one.is_listening
    assert not one._thread.is_alive()


def test_nonsense_breaks_nothing(server: MetricsServer) -> None:
    for words in (
        b"\0" * 100,
        b"GET " + b"x" * 70_000 + b"\r\n\r\n",
        b"POST /metrics HTTP/1.1\r\n\r\n",
        b"GET\r\n\r\n",
    ):
        with contextlib.suppress(ConnectionError), socket.create_connection(("127.0.0.1", server.port), 10.0) as one:
            one.sendall(words)
            one.shutdown(socket.SHUT_WR)
            while one.recv(1 << 16):
                pass
    assert "plr_answer 42.0" in scrape(server)
