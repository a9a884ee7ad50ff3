from __future__ import annotations

import os
import threading
import time
from typing import TYPE_CHECKING

import pytest

from plr.sidecar.net.thread_state import is_in_a_call

if TYPE_CHECKING:
    from collections.abc import Callable


def states(work: Callable[[threading.Event], object]) -> list[bool]:
    """Return what is seen of a thread at this work, several times."""
    over = threading.Event()
    thread = threading.Thread(target=work, args=(over,), daemon=True)
    thread.start()
    seen = []
    for _ in range(20):
        time.sleep(0.01)
        seen.append(is_in_a_call(thread.native_id))
    over.set()
    return seen


def test_who_sleeps_in_a_call_is_in_one() -> None:
    reading, writing = os.pipe()
    # The first look may come before it is there.
    assert all(states(lambda _: os.read(reading, 1))[1:])
    os.write(writing, b"x")
    os.close(writing)


def test_who_waits_for_a_lock_is_in_none() -> None:
    assert not any(states(lambda over: over.wait()))


def test_who_computes_is_in_none() -> None:
    def compute(over: threading.Event) -> None:
        while not over.is_set():
            sum(range(1000))

    assert not any(states(compute))


@pytest.mark.parametrize("thread_id", [None, 0])
def test_what_can_not_be_told_counts_as_one(thread_id: int | None) -> None:
    assert is_in_a_call(thread_id)
