from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
from typing import TYPE_CHECKING

import pytest

from plr.sidecar.net.waiter import EARLY_S, Waiter

if TYPE_CHECKING:
    from collections.abc import Iterator

PATIENCE_S = 20.0
FAR_S = 3600.0


class Sleeper:
    """A thread that does nothing but wait, until something ends it."""

    def __init__(self, waiter: Waiter) -> None:
        self.waiter = waiter
        self.thread = threading.Thread(target=waiter.wait, args=(time.monotonic() + FAR_S,), daemon=True)
        self.thread.start()

    def until_asleep(self) -> None:
        end = time.monotonic() + PATIENCE_S
        while not self.waiter._asleep and time.monotonic() < end:
            time.sleep(0.001)
        assert self.waiter._asleep

    def ended(self) -> bool:
        self.thread.join(PATIENCE_S)
        return not self.thread.is_alive()


@pytest.fixture
def ends() -> Iterator[tuple[socket.socket, socket.socket]]:
    with contextlib.ExitStack() as stack:
        near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        stack.enter_context(near)
        stack.enter_context(far)
        yield near, far


@pytest.fixture
def waiter(ends: tuple[socket.socket, socket.socket]) -> Iterator[Waiter]:
    waiter = Waiter(ends[0].fileno(), time.monotonic)
    yield waiter
    waiter.close()


def test_a_datagram_ends_the_wait(waiter: Waiter, ends: tuple[socket.socket, socket.socket]) -> None:
    sleeper = Sleeper(waiter)
    sleeper.until_asleep()
    ends[1].send(b"x")
    assert sleeper.ended()
    assert waiter.wait(time.monotonic() - 1.0)


def test_a_time_ends_the_wait_again_and_again(waiter: Waiter) -> None:
    for _ in range(20):
        due = time.monotonic() + 0.0003
        waiter.wait(due)
        assert time.monotonic() >= due


def test_a_time_that_was_put_off_does_not_end_the_wait(waiter: Waiter) -> None:
    waiter.wake()
    waiter.wait(time.monotonic() + 0.01)
    waiter.looked()
    due = time.monotonic() + 0.05
    waiter.wait(due)
    assert time.monotonic() >= due - EARLY_S


def test_a_sleeping_thread_is_woken_once(waiter: Waiter) -> None:
    for count in range(1, 6):
        sleeper = Sleeper(waiter)
        sleeper.until_asleep()
        for _ in range(10):
            waiter.wake()
        assert sleeper.ended()
        assert waiter.wakes == count
        waiter.looked()


def test_a_thread_awake_costs_no_wake_up_and_does_not_sleep_over_the_call(waiter: Waiter) -> None:
    waiter.wake()
    assert not waiter.wait(time.monotonic() + FAR_S)
    assert waiter.wakes == 0


def test_no_call_is_lost(waiter: Waiter) -> None:
    """Work handed over at every moment of the other thread's cycle is taken."""
    work: list[int] = []
    taken: list[int] = []
    rounds = 3000

    def take() -> None:
        while len(taken) < rounds:
            waiter.wait(time.monotonic() + FAR_S)
            waiter.looked()
            while work:
                taken.append(work.pop())

    thread = threading.Thread(target=take, daemon=True)
    thread.start()
    for number in range(rounds):
        work.append(number)
        waiter.wake()
        if number % 3 == 0:
            os.sched_yield()
    thread.join(PATIENCE_S)
    assert not thread.is_alive()
    assert len(taken) == rounds


def test_room_in_the_socket_ends_the_wait(waiter: Waiter, ends: tuple[socket.socket, socket.socket]) -> None:
    near, far = ends
    near.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        while True:
            near.send(b"x" * 1000)
    due = time.monotonic() + 0.01
    waiter.wait(due, for_room=True)
    assert time.monotonic() >= due
    far.recv(2000)
    far.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        while True:
            far.recv(2000)
    assert not waiter.wait(time.monotonic() + FAR_S, for_room=True)
    far.send(b"x")
    assert waiter.wait(time.monotonic() + FAR_S, for_room=True)
