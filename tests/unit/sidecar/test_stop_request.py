"""Signals that come at any moment, also while the one before is handled, end the wait and never hang it."""

from __future__ import annotations

import os
import signal
import threading
from typing import TYPE_CHECKING

import pytest

from plr.sidecar.stop_request import StopRequest

if TYPE_CHECKING:
    from collections.abc import Iterator

ROUNDS = 500


@pytest.fixture
def current() -> Iterator[list[StopRequest]]:
    """The request that SIGUSR1 sets: the last of the list."""
    requests = [StopRequest()]
    before = signal.signal(signal.SIGUSR1, lambda *_: requests[-1].set("on SIGUSR1"))
    yield requests
    signal.signal(signal.SIGUSR1, before)


def test_signals_in_quick_succession_end_the_wait(current: list[StopRequest]) -> None:
    over = threading.Event()

    def bother() -> None:
        while not over.is_set():
            os.kill(os.getpid(), signal.SIGUSR1)

    thread = threading.Thread(target=bother)
    thread.start()
    try:
        for _ in range(ROUNDS):
            current[:] = [StopRequest()]
            assert current[-1].wait(60.0) == "on SIGUSR1"
    finally:
        over.set()
        thread.join()


def test_the_first_reason_counts() -> None:
    stop = StopRequest()
    stop.set("on SIGTERM")
    stop.set("as a thread died")
    assert stop.wait(60.0) == "on SIGTERM"
